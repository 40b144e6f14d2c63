"""The endpoints of `/v1/jobs`: trainings of captures."""

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from splatmill.schema import IDEMPOTENCY_HEADER, ChangeLabels, CreateJob, Job, JobPage, JobState, ListOrder
from splatmill_server.access.caller import Caller, Who
from splatmill_server.base.filters import JobFilter
from splatmill_server.base.paging import DEFAULT_LIMIT
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs.listing import By
from splatmill_server.requests.ownership import JobId, ListedOwner
from splatmill_server.requests.parameters import JSON_ONLY, Cursor, Favourite, Limit, NamePart, Sort, TagOf
from splatmill_server.routes.jobs.form import create_from_form
from splatmill_server.routes.openapi import JOB_REQUESTS, JSON_BODY, answer, problems
from splatmill_server.service import Service, Shared

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

_LOCATION = {"Location": {"schema": {"type": "string"}, "description": "Address of the job."}}
_FORM = {
    "type": "object",
    "required": ["images"],
    "properties": {
        "images": {"type": "array", "items": {"type": "string", "format": "binary"}},
        "masks": {"type": "array", "items": {"type": "string", "format": "binary"}},
        "poses": {"type": "array", "items": {"type": "string", "format": "binary"}},
        "options": {"type": "string", "description": "`TrainOptions` as JSON."},
        "name": {"type": "string"},
        "priority": {"type": "integer", "minimum": -100, "maximum": 100},
    },
}


@router.post(
    "",
    status_code=202,
    response_model=Job,
    responses=answer(202, "The queued job", headers=_LOCATION)
    | problems(
        "malformed_body",
        "body_cut_off",
        "capture_not_found",
        "no_images",
        "too_few_images",
        "model_not_found",
        "model_not_ready",
        "file_not_found",
        "unknown_option",
        "option_out_of_range",
        "idempotency_conflict",
        "too_many_jobs",
        "body_too_large",
        "unsupported_media_type",
        "storage_full",
        "quota_exceeded",
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/CreateJob"},
                    "examples": JOB_REQUESTS,
                },
                "multipart/form-data": {"schema": _FORM},
            },
        }
    },
)
async def create_job(
    service: Shared,
    who: Who,
    request: Request,
    key: Annotated[
        str | None,
        Header(
            alias=IDEMPOTENCY_HEADER,
            min_length=1,
            max_length=200,
            description="Requests with the same key create one job, so a request whose response was lost can "
            "be repeated.",
        ),
    ] = None,
) -> Response:
    """Create a job that trains a capture, or upload photos as a form and train them in one request."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        job, new = await create_from_form(service, who, request, key)
    elif media_type == "application/json" or media_type.endswith("+json"):
        job, new = await _create_from_json(service, who, await request.body(), key)
    else:
        raise ProblemError(
            "unsupported_media_type",
            f"A job is created from JSON or from a form; the content type is "
            f"{media_type[:80] or 'missing'!r}.",
            advice="Send application/json with the id of a capture, or multipart/form-data with images.",
        )
    headers = {"Location": f"/v1/jobs/{job.id}"} | ({} if new else {"Idempotency-Replayed": "true"})
    return JSONResponse(job.model_dump(mode="json"), 202, headers)


async def _create_from_json(service: Service, who: Caller, body: bytes, key: str | None) -> tuple[Job, bool]:
    try:
        create = CreateJob.model_validate_json(body)
    except ValidationError as error:
        raise RequestValidationError(_located(error)) from error

    return await run_in_threadpool(
        lambda: service.admission.create(who, create, key=key, body=create.described())
    )


def _located(error: ValidationError) -> list[Any]:
    return [{**fault, "loc": ("body", *fault["loc"])} for fault in error.errors()]


@router.get("", responses=problems("cursor_invalid", "lists_not_ready", "list_too_long"))
def list_jobs(
    service: Shared,
    owner: ListedOwner,
    cursor: Cursor = None,
    limit: Limit = DEFAULT_LIMIT,
    state: Annotated[
        list[JobState] | None,
        Query(description="List only jobs in this state; repeat it for several states."),
    ] = None,
    name: NamePart = None,
    tag: TagOf = None,
    favourite: Favourite = None,
    capture: Annotated[
        str | None, Query(max_length=64, description="List only jobs on the capture with this id.")
    ] = None,
    sort: Sort = ListOrder.newest,
) -> JobPage:
    """List jobs. Sorted by size or PSNR, those without a model come last.

    A page of a filtered list may hold fewer than `limit` although it has a `cursor`.
    """
    states = frozenset(state) if state else None
    only = JobFilter(owner, name, tag, favourite, capture, states)
    return service.jobs.list(cursor, limit, only, By(sort, service.models.finished))


@router.get("/{job_id}", responses=problems("job_not_found"))
def get_job(service: Shared, job_id: JobId) -> Job:
    """Get a job."""
    return service.jobs.get(job_id)


@router.patch(
    "/{job_id}",
    responses=problems("job_not_found", *JSON_BODY, "storage_full"),
    dependencies=[JSON_ONLY],
)
def label_job(service: Shared, job_id: JobId, change: ChangeLabels) -> Job:
    """Change the name, the tags and the star of a job, and of its model with it."""
    return service.jobs.label(job_id, change)


@router.delete(
    "/{job_id}", status_code=204, responses=problems("job_not_found", "job_running", "model_in_use")
)
def delete_job(service: Shared, job_id: JobId) -> Response:
    """Delete a job that has ended, and its model. Its capture is kept."""
    service.deletion.job(job_id)
    return Response(status_code=204)


@router.post("/{job_id}/cancel", status_code=202, responses=problems("job_not_found", "job_finished"))
async def cancel_job(service: Shared, job_id: JobId) -> Job:
    """Cancel a job. Its state is `cancelled` once its process has ended; until then, `cancel_requested` is true."""
    job = await run_in_threadpool(service.jobs.cancel, job_id)
    if not job.state.final:
        # The first step is taken here, so that a job that waits in the queue is cancelled in this response.
        row = await run_in_threadpool(service.jobs.get_row, job_id)
        await run_in_threadpool(service.reaper.cancel, row)
        service.reaper.wake()
        job = await run_in_threadpool(service.jobs.get, job_id)
    return job


@router.post(
    "/{job_id}/restart",
    status_code=202,
    responses=problems(
        "job_not_found", "job_running", "capture_not_found", "too_many_jobs", "quota_exceeded", "storage_full"
    ),
)
def restart_job(service: Shared, who: Who, job_id: JobId) -> Job:
    """Run a job that has ended again, with the same options, from its last checkpoint if there is one."""
    return service.admission.restart(who, job_id)

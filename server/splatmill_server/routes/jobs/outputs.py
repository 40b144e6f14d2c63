"""The endpoints for the outputs of a job: events, log, preview and report."""

import json
from typing import Annotated, Literal

from fastapi import APIRouter, Header, Query
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse

from splatmill.backplane.jobs import events
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import check_format
from splatmill.schema import Curve, LogPage, Report
from splatmill_server.access.caller import Who
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs import curve as job_curve
from splatmill_server.jobs import log as job_log
from splatmill_server.requests.ownership import JobId
from splatmill_server.responses.files import file_response
from splatmill_server.responses.sse import Follower, Position, event_stream, stored_stream
from splatmill_server.routes.openapi import answer, binary, problems
from splatmill_server.service import Service, Shared

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["jobs"])


@router.get(
    "/events",
    response_class=Response,
    responses=answer(
        200,
        "Server-sent events, whose `data` is an `EventRecord`. The stream ends after the final state.",
        content={"text/event-stream": {"schema": {"$ref": "#/components/schemas/EventRecord"}}},
    )
    | answer(204, "No events follow `Last-Event-ID`; do not reconnect.")
    | problems("job_not_found", "cursor_invalid", "too_many_followers"),
)
async def follow_events(
    service: Shared,
    who: Who,
    request: Request,
    job_id: JobId,
    last_event_id: Annotated[
        str | None, Header(description="Id of the last event already received; the stream resumes after it.")
    ] = None,
) -> Response:
    """Stream the events of a job, from the beginning or after `Last-Event-ID`."""
    position = Position.parse(last_event_id) if last_event_id else Position()
    if position is None:
        raise ProblemError(
            "cursor_invalid",
            "The Last-Event-ID is not one that this service has issued.",
            advice="Send the id of an event unchanged, or leave the header out to begin with the first "
            "event.",
        )
    most = service.settings.max_event_streams
    count, own = service.feed.followers, service.feed.followers_of(who.owner)
    of_owner = most - most // 4  # so that one owner cannot take all
    if count >= most or own >= of_owner:
        raise ProblemError(
            "too_many_followers",
            f"{count} clients follow events on this server process, {own} of them with keys of this owner; it takes "
            f"{most} (SPLATMILL_MAX_EVENT_STREAMS), and {of_owner} of one owner.",
            advice="Ask for the job with GET /v1/jobs/{id} every few seconds instead, or start another API process.",
            facts={"followers": count, "limit": most, "of_owner": own, "limit_of_owner": of_owner},
            headers={"Retry-After": "10"},
        )
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    try:
        row = await run_in_threadpool(service.jobs.get_row, job_id)
    except ProblemError:
        job = await run_in_threadpool(service.jobs.get_stored, job_id)
        if job is None:
            raise
        if last_event_id:
            return Response(status_code=204)
        return StreamingResponse(stored_stream(job), media_type="text/event-stream", headers=headers)
    follower = Follower(service, job_id, position, service.authentication.again(request), who.owner)
    if not await follower.begin(row):
        return Response(status_code=204)
    stream = event_stream(follower, service.settings.heartbeat, service.metrics.streams)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


@router.get(
    "/logs",
    response_model=LogPage,
    responses=answer(200, "Lines of the log", content={"text/plain": {"schema": {"type": "string"}}})
    | problems("job_not_found"),
)
def get_logs(
    service: Shared,
    job_id: JobId,
    limit: Annotated[
        int, Query(ge=1, le=10_000, description="Largest number of lines; the last ones are returned.")
    ] = 1000,
    form: Annotated[
        Literal["json", "text"],
        Query(
            alias="format", description="json, or text for all lines as a text file; limit is ignored then."
        ),
    ] = "json",
) -> Response:
    """Get the log lines of all attempts at a job, oldest first. They are kept when the job has ended."""
    service.jobs.get(job_id)
    lines = job_log.get(service.redis, service.storage, job_id)
    if form == "text":
        headers = {"Content-Disposition": f'attachment; filename="{job_id}.log"'}
        return PlainTextResponse(job_log.text(lines), headers=headers)
    return JSONResponse(LogPage(lines=lines[-limit:]).model_dump(mode="json"))


@router.get("/curve", responses=problems("job_not_found", "model_corrupt"))
def get_curve(service: Shared, job_id: JobId) -> Curve:
    """Get the error against run time that was measured so far, from the first measurement on."""
    service.jobs.get(job_id)
    if rows := job_curve.get(service.redis, service.storage, job_id):
        return Curve(rows=rows)
    report = _report(service, job_id)
    return Curve(rows=report.curve if report is not None else [])


@router.get(
    "/preview",
    response_class=Response,
    responses=binary("The newest preview image", "image/jpeg")
    | problems("job_not_found", "preview_not_ready"),
)
async def get_preview(service: Shared, job_id: JobId, request: Request) -> Response:
    """Get the newest preview image of the scene in training."""
    await run_in_threadpool(service.jobs.get, job_id)
    path = await run_in_threadpool(_preview_path, service, job_id)
    if path is None:
        raise ProblemError(
            "preview_not_ready",
            f"The job {job_id} has no preview yet.",
            advice="Try again once the state of the job is training.",
        )
    return await file_response(request, service.storage, path, "image/jpeg")


@router.get("/report", responses=problems("job_not_found", "report_not_ready", "model_corrupt"))
def get_report(service: Shared, job_id: JobId) -> Report:
    """Get the report of a job: error against run time, the plan with its reasons, and where it ran."""
    job = service.jobs.get(job_id)
    report = _report(service, job_id)
    if report is None:
        raise ProblemError(
            "report_not_ready",
            f"The job {job_id} has no report; its state is {job.state.value}.",
            advice="The report is written with the model; try again when the job has succeeded.",
            facts={"state": job.state.value},
        )
    return report


def _report(service: Service, job_id: str) -> Report | None:
    """Return the stored report of a job, or None. Raises a problem for one that cannot be read."""
    try:
        stored = json.loads(service.storage.get(layout.model_file(job_id, "report.json")))
        check_format(stored)
        return Report.model_validate(stored)
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, AttributeError) as error:
        raise ProblemError(
            "model_corrupt", f"The report of the job {job_id} cannot be read: {error}."
        ) from error


def _preview_path(service: Service, job_id: str) -> str | None:
    """Return the path of the newest preview: that of the last event, else that of the finished model, else None."""
    announced = events.last_preview(service.redis, job_id)
    work, model = layout.job_work(job_id), layout.model(job_id)
    for name in [*([announced.path] if announced else []), layout.model_file(job_id, "preview.jpg")]:
        # A path is relative to storage or to the work folder; only files of this job are opened.
        for path in (name, f"{work}/{name}"):
            inside = path.startswith((f"{work}/", f"{model}/")) and ".." not in path.split("/")
            if inside and service.storage.exists(path):
                return path
    return None

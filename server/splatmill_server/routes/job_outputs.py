"""What a job tells while it runs: events, log, preview, report."""

from typing import Annotated

from fastapi import APIRouter, Header, Query
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from splatmill.backplane import events, layout
from splatmill.schema import LogEvent, LogLine, LogPage, PreviewEvent, Report
from splatmill_server.files import file_response
from splatmill_server.problems import ProblemError
from splatmill_server.routes.documented import answer, binary, problems
from splatmill_server.routes.jobs import JobId
from splatmill_server.service import Service, Shared
from splatmill_server.sse import Cursor, Follower, event_stream, stored_stream

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["jobs"])


@router.get(
    "/events",
    response_class=Response,
    responses=answer(
        200,
        "Server-sent events; `data` is an `EventRecord`. Ends after the final state.",
        content={"text/event-stream": {"schema": {"$ref": "#/components/schemas/EventRecord"}}},
    )
    | answer(204, "Nothing is left after `Last-Event-ID`; do not reconnect.")
    | problems("job_not_found", "cursor_invalid"),
)
async def follow_events(
    service: Shared,
    job_id: JobId,
    last_event_id: Annotated[
        str | None, Header(description="The id of the last event seen; the stream goes on after it.")
    ] = None,
) -> Response:
    """A job's events as they happen, from the beginning or after `Last-Event-ID`."""
    cursor = Cursor.parse(last_event_id) if last_event_id else Cursor()
    if cursor is None:
        raise ProblemError(
            "cursor_invalid",
            "The Last-Event-ID is not one this service gave.",
            advice="Send the id of an event as it came, or leave the header out to begin anew.",
        )
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    try:
        row = await run_in_threadpool(service.jobs.row, job_id)
    except ProblemError:
        job = await run_in_threadpool(service.jobs.stored, job_id)
        if job is None:
            raise
        if last_event_id:
            return Response(status_code=204)
        return StreamingResponse(stored_stream(job), media_type="text/event-stream", headers=headers)
    follower = Follower(service, job_id, cursor)
    if not await follower.begin(row):
        return Response(status_code=204)
    stream = event_stream(follower, service.settings.heartbeat, service.metrics.streams)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


@router.get("/logs", responses=problems("job_not_found"))
def get_logs(
    service: Shared,
    job_id: JobId,
    limit: Annotated[int, Query(ge=1, le=10_000, description="The last so many lines.")] = 1000,
) -> LogPage:
    """The job's log lines, oldest first, of all attempts."""
    service.jobs.get(job_id)
    lines = [
        LogLine(attempt=stored.attempt, at=stored.at, level=stored.event.level, message=stored.event.message)
        for stored in events.read_progress(service.redis, job_id)
        if isinstance(stored.event, LogEvent)
    ]
    return LogPage(lines=lines[-limit:])


@router.get(
    "/preview",
    response_class=Response,
    responses=binary("The newest preview picture", "image/jpeg")
    | problems("job_not_found", "preview_not_ready"),
)
async def get_preview(service: Shared, job_id: JobId, request: Request) -> Response:
    """The newest picture of the scene as it is trained."""
    await run_in_threadpool(service.jobs.get, job_id)
    path = await run_in_threadpool(_preview_path, service, job_id)
    if path is None:
        raise ProblemError(
            "preview_not_ready",
            f"The job {job_id} has no preview yet.",
            advice="Ask again when it is training.",
        )
    return await file_response(request, service.storage, path, "image/jpeg")


@router.get("/report", responses=problems("job_not_found", "report_not_ready", "model_corrupt"))
def get_report(service: Shared, job_id: JobId) -> Report:
    """Error against run time, what was planned and why, and where it ran."""
    job = service.jobs.get(job_id)
    try:
        return Report.model_validate_json(service.storage.get(layout.model_file(job_id, "report.json")))
    except FileNotFoundError as error:
        raise ProblemError(
            "report_not_ready",
            f"The job {job_id} has no report; it is {job.state.value}.",
            advice="The report is written when the model is stored.",
            facts={"state": job.state.value},
        ) from error
    except ValueError as error:
        raise ProblemError("model_corrupt", f"The report of {job_id} cannot be read: {error}.") from error


def _preview_path(service: Service, job_id: str) -> str | None:
    """Where the newest preview lies: where the last event says, else beside the finished model."""
    said = [
        stored.event.path
        for stored in events.read_progress(service.redis, job_id)
        if isinstance(stored.event, PreviewEvent)
    ]
    work, model = layout.job_work(job_id), layout.model(job_id)
    for name in [*reversed(said[-2:]), layout.model_file(job_id, "preview.jpg")]:
        # An event may name a place in storage or in the work folder; only this job's own places are opened.
        for path in (name, f"{work}/{name}"):
            inside = path.startswith((f"{work}/", f"{model}/")) and ".." not in path.split("/")
            if inside and service.storage.exists(path):
                return path
    return None

"""The endpoints that show a job while it runs: its cameras, and the scene in training for those who watch it."""

from typing import cast

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import SNAPSHOT_MEDIA_TYPE, Placement, Scope, Watch
from splatmill_server.access.permission import needs
from splatmill_server.base.problems import ProblemError
from splatmill_server.requests.ownership import JobId
from splatmill_server.responses.files import file_response, matches
from splatmill_server.routes.openapi import answer, binary, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["jobs"])

WATCH_SECONDS = 20.0
"""Seconds for which a job makes snapshots after a request."""


@router.get(
    "/cameras",
    response_model=Placement,
    responses=answer(304, "They are unchanged") | problems("job_not_found", "cameras_not_ready"),
)
async def get_job_cameras(service: Shared, job_id: JobId, request: Request) -> Response:
    """Get the cameras and points as structure from motion places them, and the photos that are not used."""
    await run_in_threadpool(service.jobs.get, job_id)
    path = layout.job_cameras(job_id)
    if not await run_in_threadpool(service.storage.exists, path):
        raise ProblemError(
            "cameras_not_ready",
            f"No camera of the job {job_id} is known yet.",
            advice="Try again once the state of the job is training, or after the next event of the type cameras.",
        )
    return await file_response(request, service.storage, path, "application/json")


@router.post("/watch", responses=problems("job_not_found"))
@needs(Scope.read)
def watch_job(service: Shared, job_id: JobId) -> Watch:
    """Ask a job for snapshots of its scene in training. It makes them until the seconds of the answer are over.

    A job that has ended makes none: the seconds are 0. Nothing of the job changes, and its training clock stands still
    while a snapshot is made.
    """
    if service.jobs.get(job_id).state.final:
        return Watch(seconds=0.0)  # no error: who watches a job cannot know that it is about to end
    service.redis.set(keys.watched(job_id), b"1", px=round(WATCH_SECONDS * 1000))
    return Watch(seconds=WATCH_SECONDS)


@router.get(
    "/snapshot",
    response_class=Response,
    responses=binary(
        "The newest snapshot: a compressed .ply without spherical harmonics", SNAPSHOT_MEDIA_TYPE
    )
    | answer(304, "The snapshot is unchanged")
    | problems("job_not_found", "snapshot_not_ready"),
)
def get_snapshot(service: Shared, job_id: JobId, request: Request) -> Response:
    """Get the newest snapshot of the scene in training, of a job that is watched. It is kept for a minute."""
    service.jobs.get(job_id)
    key = keys.snapshot(job_id)
    headers = {"Cache-Control": "private, no-cache", "Content-Type": SNAPSHOT_MEDIA_TYPE}
    known = request.headers.get("if-none-match")
    if known is not None and (tag := cast(bytes | None, service.redis.hget(key, "tag"))) is not None:
        headers["ETag"] = f'"{tag.decode()}"'
        if matches(known, headers["ETag"]):
            return Response(status_code=304, headers=headers)
    ply, tag = cast(list[bytes | None], service.redis.hmget(key, ["ply", "tag"]))
    if ply is None or tag is None:
        raise ProblemError(
            "snapshot_not_ready",
            f"There is no snapshot of the scene of the job {job_id} now.",
            advice="A job makes snapshots while it trains and is watched: send POST to /v1/jobs/{id}/watch, and wait "
            "for an event of the type snapshot.",
        )
    headers["ETag"] = f'"{tag.decode()}"'
    return Response(ply, headers=headers)

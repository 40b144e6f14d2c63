"""The endpoints about the service itself: options, info, health and metrics."""

import asyncio
import shutil
from collections.abc import Sequence
from dataclasses import asdict

import httpx
import redis
import structlog
from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse, JSONResponse, Response

import splatmill
from splatmill.backplane import memory, rendering
from splatmill.backplane.queue import entries, lines, workers
from splatmill.backplane.queue.lines import Waiting
from splatmill.backplane.queue.workers import WorkerRecord
from splatmill.backplane.rendering import RendererState
from splatmill.data_sets import LARGE, LISTS, OTHER_CAMERAS, PROGRAM_FILES
from splatmill.schema import (
    ARCHIVE_SUFFIXES,
    EXAMPLE_FILE,
    MASK_BEGINNINGS,
    MASK_ENDINGS,
    MASK_FOLDERS,
    MASK_SUFFIXES,
    MAX_PHOTO_PIXELS,
    MAX_RENDER_PIXELS,
    MIN_PHOTO_SIDE,
    MIN_PHOTOS,
    OUTPUT_MARKS,
    OUTPUT_MEDIA,
    PHOTO_SUFFIXES,
    UNREAD_KINDS,
    VIDEO_SUFFIXES,
    Accepted,
    Health,
    Info,
    Lan,
    LanAccess,
    Limits,
    OptionList,
    QueueInfo,
    Ready,
    Scope,
    Unread,
    WorkerInfo,
    describe_options,
)
from splatmill.schema.files.formats import POINT_FORMATS
from splatmill.schema.files.other_pictures import MEASURED, OTHER_FOLDERS, UNUSED
from splatmill_server.access.caller import Caller, Who
from splatmill_server.access.permission import needs
from splatmill_server.base import metrics, scrape
from splatmill_server.base.problems import LOGGED, ProblemError
from splatmill_server.base.settings import Settings
from splatmill_server.base.tls import fingerprint
from splatmill_server.responses.docs_page import CONTENT_SECURITY_POLICY, docs_page
from splatmill_server.routes.openapi import answer, problems
from splatmill_server.service import Service, Shared

log = structlog.get_logger()

router = APIRouter(tags=["service"])

_RENDERER_SECONDS = 1.0
"""Seconds that the metrics wait for the renderer."""


@router.get("/v1/options", responses=problems())
def get_options() -> OptionList:
    """List the training options with type, default, range and help."""
    return OptionList(options=describe_options())


@router.get("/v1/info", responses=problems())
def get_info(service: Shared, who: Who) -> Info:
    """Get the version, the limits, the workers and the number of waiting jobs."""
    listening, waiting = workers.listening(service.redis), lines.look(service.redis)
    queues = _queues(waiting, listening)
    return Info(
        version=splatmill.__version__,
        storage="file" if service.storage.root is not None else "s3",
        workers=[_seen_by(service, who, _shown(worker), n) for n, worker in enumerate(listening, 1)],
        queued=sum(queue.waiting for queue in queues.values()),
        queues=queues,
        limits=Limits(
            max_file_bytes=service.settings.max_file_bytes,
            max_files_per_capture=service.settings.max_files_per_capture,
            max_image_pixels=MAX_PHOTO_PIXELS,
            max_render_pixels=MAX_RENDER_PIXELS,
        ),
        accepted=Accepted(
            photos=list(PHOTO_SUFFIXES),
            videos=list(VIDEO_SUFFIXES),
            archives=list(ARCHIVE_SUFFIXES),
            masks=list(MASK_SUFFIXES),
            mask_folders=list(MASK_FOLDERS),
            mask_endings=list(MASK_ENDINGS),
            mask_beginnings=list(MASK_BEGINNINGS),
            other_folders={what: list(names) for what, names in OTHER_FOLDERS.items()},
            unused_folders=list(UNUSED),
            depth_folders=list(MEASURED),
            output_marks=list(OUTPUT_MARKS),
            output_media=list(OUTPUT_MEDIA),
            unread=[Unread(**asdict(kind)) for kind in UNREAD_KINDS],
            program_files=[pattern for patterns in PROGRAM_FILES.values() for pattern in patterns],
            camera_lists=list(LISTS),
            large_cameras=list(LARGE),
            other_cameras={program: list(names) for program, names in OTHER_CAMERAS.items()},
            points=list(POINT_FORMATS),
            example=EXAMPLE_FILE,
            min_photos=MIN_PHOTOS,
            min_photo_side=MIN_PHOTO_SIDE,
        ),
        local=service.settings.local,
        lan=_lan(service.settings),
        details={"renderer": service.renderer is not None},
    )


def _lan(settings: Settings) -> Lan | None:
    if settings.lan_url is None or settings.tls_certificate is None:
        return None
    return Lan(url=settings.lan_url, fingerprint=fingerprint(settings.tls_certificate))


@router.get("/v1/lan", responses=problems("not_found"))
@needs(Scope.admin)
def get_lan(service: Shared, response: Response) -> LanAccess:
    """Get the address and the key by which devices of the local network use the server (`splatmill up --lan`)."""
    lan, key = _lan(service.settings), service.settings.api_key
    if lan is None:
        raise ProblemError(
            "not_found",
            "The server was not started for the devices of the local network.",
            advice="Start it with `splatmill up --lan`.",
        )
    response.headers["Cache-Control"] = "no-store"
    return LanAccess(**lan.model_dump(), key=None if key is None else key.get_secret_value())


@router.get("/docs", include_in_schema=False)
def get_docs(request: Request) -> Response:
    """Get an overview of the endpoints as a web page."""
    headers = {"Content-Security-Policy": CONTENT_SECURITY_POLICY}
    return HTMLResponse(docs_page(request.app.openapi()), headers=headers)


@router.get("/healthz")
async def healthz() -> Health:
    """Check that the process runs."""
    return Health()


@router.get(
    "/readyz",
    response_model=Ready,
    responses={503: {"model": Ready, "description": "A part that jobs need is not available"}},
)
async def readyz(service: Shared) -> Response:
    """Check that jobs can be accepted and run.

    A missing renderer and a Redis whose memory is nearly full are reported, but jobs can still be taken.
    """
    redis_check, memory_check, full = await run_in_threadpool(_redis_checks, service)
    checks = {
        "redis": redis_check,
        "redis_memory": memory_check,
        "storage": await run_in_threadpool(service.storage_check.result),
        "renderer": await _renderer_check(service),
    }
    ready = checks["redis"] == checks["storage"] == "ok" and not full
    return JSONResponse(Ready(ready=ready, checks=checks).model_dump(), 200 if ready else 503)


@router.get(
    "/metrics",
    response_class=Response,
    responses=answer(200, "The metrics", content={"text/plain": {}}) | problems(),
)
@needs(Scope.metrics)
async def get_metrics(service: Shared) -> Response:
    """Get the metrics in the text format of Prometheus. A key needs the scope `metrics` or `admin`."""
    values, state = await asyncio.gather(run_in_threadpool(_redis_values, service), _renderer_state(service))
    families = [*scrape.families(values), *scrape.of_disk(_spare(service)), *scrape.of_renderer(state)]
    return Response(service.metrics.text(families), media_type=metrics.MEDIA_TYPE)


def _redis_values(service: Service) -> scrape.RedisValues | None:
    """Return the values in Redis, or None if it does not answer."""
    try:
        return scrape.read(service.redis)
    except redis.RedisError:
        return None


def _spare(service: Service) -> int | None:
    """Return the bytes that are free on the disk of storage beyond its reserve; None for a bucket."""
    if service.storage.root is None:
        return None
    try:
        return shutil.disk_usage(service.storage.root).free - service.settings.min_free_bytes
    except OSError:
        return None


async def _renderer_state(service: Service) -> RendererState | None:
    """Return the state of the renderer. None: there is none."""
    if service.renderer is None:
        return None
    try:
        answer = await service.renderer.get(rendering.HEALTH, timeout=_RENDERER_SECONDS)
        return RendererState.model_validate(answer.json()) if answer.is_success else RendererState()
    except (httpx.HTTPError, ValueError):
        return RendererState()


def _queues(waiting: Waiting, listening: Sequence[WorkerRecord]) -> dict[str, QueueInfo]:
    return {
        line: QueueInfo(waiting=waiting.count(line), workers=len(workers.serving(listening, line)))
        for line in lines.LINES
    }


def _shown(worker: WorkerRecord) -> WorkerInfo:
    return WorkerInfo(
        name=worker.name,
        queues=list(worker.lines),
        state=worker.state,
        job=_job_of(worker.entry),
        last_heartbeat=worker.last_heartbeat,
    )


def _seen_by(service: Service, who: Caller, worker: WorkerInfo, number: int) -> WorkerInfo:
    """Return what the caller may know of a worker: not its machine, which its name begins with, nor others' jobs."""
    if who.admin:
        return worker
    job = worker.job if worker.job is not None and who.may_see(service.jobs.get_owner(worker.job)) else None
    return worker.model_copy(update={"name": f"worker-{number}", "job": job})


def _job_of(rq_id: str | None) -> str | None:
    try:
        return entries.split_rq_id(rq_id)[0] if rq_id else None
    except ValueError:
        return rq_id


def _redis_checks(service: Service) -> tuple[str, str, bool]:
    """Return what is to say of Redis and of its memory, and whether that is full."""
    try:
        memory_use = memory.read(service.redis)
    except redis.RedisError as error:
        log.warning(
            "Redis is not ready", error=str(error)
        )  # anybody may ask, and the text may name hosts and users
        refused = isinstance(error, redis.ResponseError | redis.AuthenticationError)
        said = "Redis refuses the request" if refused else "Redis cannot be reached"
        return f"{said}; {LOGGED}", "not known", False
    return "ok", " ".join(memory_use.trouble() or ["ok"]), memory_use.full


async def _renderer_check(service: Service) -> str:
    if service.renderer is None:
        return "none is configured"
    try:
        answer = await service.renderer.get(rendering.HEALTH, timeout=2.0)
    except Exception as error:
        return f"the renderer cannot be reached: {type(error).__name__}"
    return "ok" if answer.is_success else f"the renderer answers with status {answer.status_code}"

"""The ASGI app: `create_app(settings)`. Importing this module does nothing; making an app opens its storage."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

import structlog
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware

import splatmill
from splatmill.backplane.storage import StorageError
from splatmill.schema import CreateJob, EventRecord, Problem
from splatmill_server import problems
from splatmill_server.edge import Edge
from splatmill_server.routes import captures, job_outputs, jobs, models, status
from splatmill_server.service import Service
from splatmill_server.settings import Settings

log = structlog.get_logger()

_DESCRIPTION = """Photos in, Gaussian splats out.

Upload photos to a capture, start a job on it, follow its events, and download or render the model.
Errors are problem documents (RFC 9457) with a stable `code`, the facts, and advice.
Cameras are 4x4 row-major camera-to-world matrices with OpenCV axes (x right, y down, z forward).
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """The app for these settings (default: from the environment).

    Redis need not be there yet. Raises StorageError when the storage cannot be opened.
    """
    settings = settings or Settings()
    service = Service.of(settings)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        reaper = asyncio.create_task(service.reaper.run())
        sweep = asyncio.create_task(run_in_threadpool(_sweep, service))
        try:
            yield
        finally:
            service.closing.set()
            reaper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await reaper
            await sweep
            await service.close()

    app = FastAPI(
        title="Splatmill",
        version=splatmill.__version__,
        description=_DESCRIPTION,
        lifespan=lifespan,
        redoc_url=None,
        middleware=[Middleware(Edge, settings=settings, metrics=service.metrics)],
    )
    app.state.service = service
    problems.install(app)
    for module in (captures, jobs, job_outputs, models, status):
        app.include_router(module.router)
    _describe(app, with_key=settings.api_key is not None)
    return app


def _sweep(service: Service) -> None:
    try:
        if gone := service.captures.sweep():
            log.info("removed what broken uploads had left", files=gone)
    except StorageError as error:
        log.warning("could not look for broken uploads", error=str(error))


def _describe(app: FastAPI, *, with_key: bool) -> None:
    """Add to the OpenAPI document what FastAPI cannot see: models behind `$ref`s of ours, and the API key."""

    def openapi() -> dict[str, object]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=app.routes
            )
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            for model in (Problem, CreateJob, EventRecord):
                schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
                for name, definition in schema.pop("$defs", {}).items():
                    schemas.setdefault(name, definition)
                schemas[model.__name__] = schema
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            if with_key:
                document["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
                document["security"] = [{"key": []}]
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]

"""`create_app`, which returns the ASGI app. Importing this module has no side effects."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Sequence
from functools import cache

import structlog
from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.middleware import Middleware
from starlette.routing import BaseRoute

import splatmill
from splatmill.schema import CreateJob, EventRecord, Problem
from splatmill_server.access.cors import pages_of_others
from splatmill_server.access.exposure import check_exposure, unbounded_trust
from splatmill_server.access.permission import PERMITTED, is_open
from splatmill_server.access.sessions import COOKIE
from splatmill_server.base import cancelling, problems, root_path
from splatmill_server.base.proxies import TrustedProxies
from splatmill_server.base.settings import Settings
from splatmill_server.middleware import RequestMiddleware
from splatmill_server.responses.packed import PackedCameras
from splatmill_server.routes import bin as bin_routes
from splatmill_server.routes import (
    captures,
    imports,
    session,
    shared,
    shares,
    status,
    storage,
    uploads,
    webhooks,
)
from splatmill_server.routes import keys as key_routes
from splatmill_server.routes.jobs import estimate, jobs, live, outputs
from splatmill_server.routes.models import camera_paths, edits, meshes, models, orbits, presentation
from splatmill_server.service import Service
from splatmill_server.web import pages

log = structlog.get_logger()

_STOP_SECONDS = 5.0
"""Seconds for which threads that work beside the answers may go on after the process was stopped."""

_DESCRIPTION = """Photos in, Gaussian splats out.

Upload photos to a capture, start a job on it, follow its events, and download or render the model.
Errors are problem documents (RFC 9457) with a stable `code`, the facts behind them, and advice.
Cameras are 4x4 row-major camera-to-world matrices with OpenCV axes (x right, y down, z forward).
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """Return the app for `settings`; by default, for the settings in the environment.

    Redis need not run yet. Raises StorageError if storage cannot be opened, and NeedsKey for a server without keys that
    other machines could reach.
    """
    settings = settings or Settings()
    service = Service.of(settings)
    check_exposure(settings, service.keys)
    if (warning := unbounded_trust(settings)) is not None:
        log.warning(warning)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        root_path.use(settings.root_path)  # what is sent without a request, such as webhooks, has it too
        loops = (
            service.reaper.run,
            service.ends.run,
            service.imports.run,
            service.orbits.run,
            service.meshes.run,
            service.deliveries.run,
            service.relisting.run,
            service.sweeper.run,
        )
        tasks = [asyncio.create_task(loop()) for loop in loops]
        try:
            yield
        finally:
            service.closing.set()
            await cancelling.end(*tasks)
            # The process ends with its threads, and a sweep, or lists that are made, may go through all of storage.
            end = threading.Timer(_STOP_SECONDS, service.storage.close)
            end.daemon = True
            end.start()
            await service.close()

    app = FastAPI(
        title="Splatmill",
        version=splatmill.__version__,
        description=_DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,  # FastAPI's pages load scripts from other hosts
        redoc_url=None,
        middleware=[
            Middleware(TrustedProxies, trusted_hosts=settings.forwarded_allow_ips),
            *pages_of_others(settings.cors),
            Middleware(RequestMiddleware, service=service),
            Middleware(PackedCameras),
        ],
    )
    app.state.service = service
    problems.install(app, pages.missing_page)
    app.router.routes.extend(_routes())
    _describe(app, keyless=settings.local and settings.api_key is None)
    return app


@cache
def _routes() -> Sequence[BaseRoute]:
    """Return the endpoints. All apps of a process share them: what FastAPI makes of their signatures is made once."""
    router = APIRouter()
    modules = (
        captures,
        uploads,
        imports,
        jobs,
        live,
        outputs,
        estimate,
        edits,
        models,
        orbits,
        meshes,
        camera_paths,
        presentation,
        shares,
        bin_routes,
        webhooks,
        key_routes,
        session,
        status,
        storage,
    )
    for module in modules:
        router.include_router(module.router, dependencies=[PERMITTED])
    router.include_router(shared.router)  # for people without a key
    router.include_router(pages.router)
    return router.routes


def _describe(app: FastAPI, *, keyless: bool) -> None:
    """Add what FastAPI cannot infer to the OpenAPI document: models that only `$ref`s name, and how callers are known.

    keyless: whether the server may have no keys.
    """

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
            document["components"]["securitySchemes"] = {
                "key": {"type": "http", "scheme": "bearer"},
                "session": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            }
            document["security"] = [{"key": []}, {"session": []}, *([{}] if keyless else [])]
            for path, operations in document["paths"].items():
                if is_open(path):
                    for operation in operations.values():
                        operation["security"] = []
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI documents this assignment

"""The HTTP process that renders stored models; the API forwards to it (paths in splatmill.backplane.rendering).

One view is rendered at a time, with all cores; a few requests wait, more are sent away. Torch and the kernels
are loaded by the first view, so that an idle renderer costs little.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import sys
import tempfile
import traceback
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TypeVar

import uvicorn
from pydantic import BaseModel, ValidationError
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from splatmill.backplane import layout, rendering
from splatmill.backplane.storage import Storage, StorageError
from splatmill.schema import PROBLEM_MEDIA_TYPE, ModelCameras, OrbitRequest, Problem, RenderRequest
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.render_service.model_cache import ModelCache, NoModelError, StoredModel
from splatmill_worker.settings import storage_url

WAITING = 8
"""Requests that may wait for their turn; a picture takes a fraction of a second, a browser asks for a few."""

RETRY_AFTER = 2
_VERSION = b"1"
"""Part of every ETag; to be raised when the same request gives other bytes."""

Answer = TypeVar("Answer")
Wish = TypeVar("Wish", bound=BaseModel)


class Busy(Exception):
    """More requests wait than the renderer takes."""


class Turns:
    """One at a time, a bounded number waiting."""

    def __init__(self, waiting: int) -> None:
        self._most = waiting + 1
        self._here = 0
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def admitted(self) -> AsyncIterator[None]:
        """Stand in the queue for the length of a request. Raises Busy when it is full."""
        if self._here >= self._most:
            raise Busy
        self._here += 1
        try:
            yield
        finally:
            self._here -= 1

    async def run(self, work: Callable[[], Answer]) -> Answer:
        """Run blocking work when nobody else's runs."""
        async with self._lock:
            return await run_in_threadpool(work)


class Renderer:
    """The endpoints over one storage. `cache_bytes` bounds the models kept in memory; `backend` as in kernels."""

    def __init__(self, storage: Storage, cache_bytes: int, backend: str | None = None) -> None:
        self.storage = storage
        self.cache = ModelCache(storage, cache_bytes, backend)
        self.turns = Turns(WAITING)

    def app(self) -> Starlette:
        """The ASGI app."""
        return Starlette(
            routes=[
                Route(rendering.HEALTH, self.health),
                Route(rendering.render_path("{model_id}"), self.render, methods=["POST"]),
                Route(rendering.orbit_path("{model_id}"), self.orbit, methods=["POST"]),
            ]
        )

    async def health(self, request: Request) -> Response:
        return JSONResponse({"status": "ok"})

    async def render(self, request: Request) -> Response:
        """A picture."""
        return await self._answer(request, RenderRequest, self._picture)

    async def orbit(self, request: Request) -> Response:
        """A video."""
        return await self._answer(request, OrbitRequest, self._video)

    async def _answer(
        self,
        request: Request,
        kind: type[Wish],
        make: Callable[[Request, str, Wish, dict[str, str]], Awaitable[Response]],
    ) -> Response:
        model_id = request.path_params["model_id"]
        try:
            wish = kind.model_validate_json(await request.body() or b"{}")
            etag = await run_in_threadpool(self._etag, model_id, wish)
            headers = {"ETag": etag, "Cache-Control": "private, max-age=0, must-revalidate"}
            if _matches(request.headers.get("if-none-match"), etag):
                return Response(status_code=304, headers=headers)
            async with self.turns.admitted():
                return await make(request, model_id, wish, headers)
        except ValidationError as error:
            return _refuse(_invalid(error))
        except NoModelError:
            return _refuse(Problem.of("model_not_found", f"There is no finished model {model_id[:80]!r}."))
        except Busy:
            problem = Problem.of(
                "renderer_unavailable",
                f"The renderer is busy: {WAITING} requests wait already.",
                advice=f"Try again in {RETRY_AFTER} seconds.",
            )
            return _refuse(problem, {"Retry-After": str(RETRY_AFTER)})
        except StorageError as error:
            return _refuse(Problem.of("storage_unavailable", str(error)))
        except Exception as error:  # whatever it is, the client gets a problem document and the log the trace
            return _refuse(_failed(error, model_id))

    def _etag(self, model_id: str, wish: BaseModel) -> str:
        shape = wish.canonical() if isinstance(wish, RenderRequest) else wish.model_dump_json().encode()
        content = b"\0".join([_VERSION, model_id.encode(), self.cache.etag(model_id).encode(), shape])
        return f'"{hashlib.sha256(content).hexdigest()[:32]}"'

    async def _picture(
        self, request: Request, model_id: str, wish: RenderRequest, headers: dict[str, str]
    ) -> Response:
        def work() -> Response:
            from splatmill_worker.render_service import encoding

            taken = encoding.take(self.cache.get(model_id), wish)
            return Response(taken.data, media_type=taken.media_type, headers=headers | dict(taken.headers))

        return await self.turns.run(work)

    async def _video(
        self, request: Request, model_id: str, wish: OrbitRequest, headers: dict[str, str]
    ) -> Response:
        """Frame by frame, so that pictures come in between, and a client that left is noticed."""
        from splatmill_worker.film import Film
        from splatmill_worker.render_service import encoding

        model = await self.turns.run(lambda: self.cache.get(model_id))
        cameras = await run_in_threadpool(self._orbit_cameras, model, wish)
        descriptor, name = tempfile.mkstemp(prefix="splatmill-orbit-", suffix=".mp4")
        os.close(descriptor)
        path = Path(name)
        try:
            video = Film(path, wish.width, wish.height, wish.fps)
            try:
                for camera in cameras:
                    if await request.is_disconnected():
                        break
                    await self.turns.run(
                        lambda camera=camera: video.add(encoding.frame(model, camera, wish.background))  # type: ignore[misc]
                    )
            finally:
                await run_in_threadpool(video.close)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        gone = BackgroundTask(path.unlink, missing_ok=True)
        return FileResponse(path, media_type="video/mp4", headers=headers, background=gone)

    def _orbit_cameras(self, model: StoredModel, wish: OrbitRequest) -> list[object]:
        from splatmill_worker.render_service import orbit

        try:
            text = self.storage.get(layout.model_file(model.id, "cameras.json"))
            stored = ModelCameras.model_validate_json(text)
        except (FileNotFoundError, ValidationError):
            stored = None
        return list(orbit.of_model(stored, model.gaussians.means.double().cpu().numpy(), wish))


def serve(host: str, port: int, uds: Path | None, backend: str | None = None) -> int:
    """Run the renderer until told to stop; returns the exit status. SPLATMILL_RENDER_CACHE bounds its models."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    cache_bytes = int(os.environ.get("SPLATMILL_RENDER_CACHE") or min(1 << 30, memory // 8))
    try:
        renderer = Renderer(Storage(storage_url()), cache_bytes, backend)
    except StorageError as error:
        print(error, file=sys.stderr)
        return 1
    config = uvicorn.Config(
        renderer.app(),
        host=host,
        port=port,
        uds=str(uds) if uds else None,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=2,
        lifespan="off",
    )
    if uds is not None:
        uds.unlink(missing_ok=True)
    server = uvicorn.Server(config)
    server.run()
    return 0 if server.started else 1


def _matches(header: str | None, etag: str) -> bool:
    """Whether an `If-None-Match` names this ETag (weakly compared, as RFC 9110 wants it)."""
    if header is None:
        return False
    known = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    return etag in known or "*" in known


def _refuse(problem: Problem, headers: dict[str, str] | None = None) -> Response:
    return Response(
        problem.model_dump_json(exclude_none=True),
        status_code=problem.status,
        media_type=PROBLEM_MEDIA_TYPE,
        headers=headers,
    )


def _invalid(error: ValidationError) -> Problem:
    found = error.errors(include_url=False, include_input=False, include_context=False)
    first = found[0]
    where = ".".join(str(part) for part in first["loc"]) or "the request"
    camera = bool(first["loc"]) and first["loc"][0] == "camera"
    size = first["loc"][-1:] in (("width",), ("height",))
    code = "size_out_of_range" if size else "camera_invalid" if camera else "invalid_request"
    said = first["msg"].removeprefix("Value error, ")
    return Problem.of(code, f"{where}: {said}", facts={"errors": [dict(each) for each in found]})


def _failed(error: Exception, model_id: str) -> Problem:
    if isinstance(error, ModelUnreadable):
        return Problem.of("model_corrupt", str(error), advice=f"Restart the job {model_id}.")
    lines = str(error).strip().splitlines() or ["no message"]
    traceback.print_exception(error)
    return Problem.of(
        "render_failed",
        f"The view could not be rendered: {type(error).__name__}: {lines[0][:300]}",
        advice="Ask for a smaller picture; the renderer's log says more.",
    )

"""The HTTP endpoints of the renderer. The API forwards requests to them (paths in splatmill.backplane.rendering).

Torch and the kernels are loaded with the first image, so that an idle renderer is small.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import BaseModel, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import (
    CONVERSION_HEADER,
    DOWNLOADS,
    EDIT_HEADER,
    PROBLEM_MEDIA_TYPE,
    Conversion,
    ConversionRequest,
    EditModel,
    JoinOrbit,
    MeshRequest,
    ModelCameras,
    OrbitFrames,
    OrbitRequest,
    Problem,
    RenderRequest,
)
from splatmill.schema.headers import write_json
from splatmill_worker.errors import ModelNotFound, ModelUnreadable
from splatmill_worker.render_service.mesh_process import MeshMaker, MeshResponse
from splatmill_worker.render_service.model_cache import LoadedModel, ModelCache
from splatmill_worker.render_service.render_queue import ClientGone, QueueFull, RenderQueue
from splatmill_worker.render_service.scratch import ScratchMiddleware, scratch
from splatmill_worker.scene import Camera

if TYPE_CHECKING:
    from splatmill_worker.splat.gaussians import Gaussians

MAX_WAITING = 48
"""Number of requests that may wait while one is rendered. An image takes a fraction of a second."""

MAX_OF_OWNER = 24
"""Number of requests of one owner among them, with the one that is rendered."""

RESERVED = 12
"""Number of places that only owners with no other request in the queue get."""

MAX_OF_CLIENT = 9
"""Number of requests of one client among them, with the one that is rendered. A browser requests a few at a time."""

RETRY_AFTER = 2
"""Seconds after which a client may repeat a request that found the queue full."""

CLIENT_GONE = 499
"""Status of a response to a client that has closed its connection, which nobody reads."""

_ENCODING_VERSION = b"1"
"""Part of each ETag, to be raised when the same request gives other bytes than before."""

Body = TypeVar("Body", bound=BaseModel)

log = logging.getLogger("splatmill.renderer")


class FormatUnknown(Exception):
    """The model was to be converted to a format that is not written."""

    def __init__(self, key: str) -> None:
        super().__init__(f"There is no format {key[:40]!r}. Those that are: {', '.join(DOWNLOADS)}.")


class RenderApp:
    """The endpoints for the models of one storage.

    storage: where the models are.
    cache_bytes: bound on the memory of cached models.
    backend: the kernels to render with; None means those of the CPU.
    """

    def __init__(self, storage: Storage, cache_bytes: int, backend: str | None = None) -> None:
        self._storage = storage
        self._backend = backend
        self._cache = ModelCache(storage, cache_bytes, backend)
        self._meshes = MeshMaker(storage, backend)
        self._queue = RenderQueue(MAX_WAITING, MAX_OF_CLIENT, MAX_OF_OWNER, RESERVED)
        # Beside the pictures, as the conversion of a million Gaussians takes a minute.
        self._conversions = RenderQueue(MAX_WAITING, MAX_OF_CLIENT, MAX_OF_OWNER, RESERVED)

    def asgi(self) -> Starlette:
        """Return the ASGI application."""
        return Starlette(
            routes=[
                Route(rendering.HEALTH, self.health),
                Route(rendering.render_path("{model_id}"), self.render, methods=["POST"]),
                Route(rendering.orbit_path("{model_id}"), self.orbit, methods=["POST"]),
                Route(rendering.orbit_frames_path("{model_id}"), self.orbit_frames, methods=["POST"]),
                Route(rendering.orbit_join_path("{model_id}"), self.orbit_join, methods=["POST"]),
                Route(rendering.convert_path("{model_id}"), self.convert, methods=["POST"]),
                Route(rendering.edits_path("{model_id}"), self.edit, methods=["POST"]),
                Route(rendering.mesh_path("{model_id}"), self.mesh, methods=["POST"]),
            ],
            middleware=[Middleware(ScratchMiddleware)],
        )

    async def health(self, request: Request) -> Response:
        """Respond that the process is alive, and how busy it is."""
        admitted = self._queue.admitted_count + self._conversions.admitted_count
        state = rendering.RendererState(status="ok", admitted=admitted, cached=self._cache.bytes)
        return JSONResponse(state.model_dump())

    async def render(self, request: Request) -> Response:
        """Respond with an image."""
        return await self._respond(request, RenderRequest, self._image)

    async def orbit(self, request: Request) -> Response:
        """Respond with a video."""
        return await self._respond(request, OrbitRequest, self._video)

    async def orbit_frames(self, request: Request) -> Response:
        """Respond with a video of some frames of an orbit."""
        return await self._respond(request, OrbitFrames, self._frames)

    async def orbit_join(self, request: Request) -> Response:
        """Respond with the video of all frames of an orbit that are stored."""
        return await self._respond(request, JoinOrbit, self._joined)

    async def convert(self, request: Request) -> Response:
        """Respond with the model in another file format."""
        return await self._respond(request, ConversionRequest, self._converted)

    async def edit(self, request: Request) -> Response:
        """Respond with an edited model."""
        return await self._respond(request, EditModel, self._edited)

    async def mesh(self, request: Request) -> Response:
        """Respond with lines of progress, and then a mesh."""
        return await self._respond(request, MeshRequest, self._mesh)

    async def _respond(
        self,
        request: Request,
        kind: type[Body],
        make: Callable[[Request, str, Body, dict[str, str]], Awaitable[Response]],
    ) -> Response:
        """Parse the body, compare ETags, wait for a place in the queue, and turn each error into a problem."""
        model_id = request.path_params["model_id"]
        queue = self._conversions if kind is ConversionRequest else self._queue
        try:
            body = kind.model_validate_json(await request.body() or b"{}")
            etag = await run_in_threadpool(self._etag, model_id, body)
            headers = {"ETag": etag, "Cache-Control": "private, max-age=0, must-revalidate"}
            if _matches(request.headers.get("if-none-match"), etag):
                return Response(status_code=304, headers=headers)
            async with queue.admitted(_client(request)):
                return await make(request, model_id, body, headers)
        except ValidationError as error:
            return _problem_response(_problem_of_validation(error))
        except ModelNotFound as error:
            return _problem_response(error.problem())
        except ModelUnreadable as error:
            advice = f"Restart the job {model_id}."
            return _problem_response(Problem.of(error.code, error.message.rstrip(".") + ".", advice=advice))
        except ClientGone:
            return Response(status_code=CLIENT_GONE)
        except FormatUnknown as error:
            return _problem_response(Problem.of("format_unknown", str(error)))
        except QueueFull:
            problem = Problem.of(
                "renderer_unavailable",
                f"The renderer is busy: its {MAX_WAITING} places for requests that wait are taken, or "
                f"{MAX_OF_CLIENT} by this client, or {MAX_OF_OWNER} by this owner.",
                advice=f"Try again in {RETRY_AFTER} seconds.",
            )
            return _problem_response(problem, {"Retry-After": str(RETRY_AFTER)})
        except StorageError as error:
            log.warning("storage error: %s", error)
            # Without the message, which may name folders and hosts: visitors of a shared link read this too.
            detail = f"{error.summary.removesuffix('.')}; the log of the renderer has the reason."
            advice = "Check SPLATMILL_STORAGE and try again."
            return _problem_response(Problem.of("storage_unavailable", detail, advice=advice))
        except Exception as error:
            # The client receives a problem document for any error, and the log receives the traceback.
            said = {"request": request.headers.get(rendering.REQUEST_HEADER, "")[:64]}
            log.exception("a request for the model %s failed", model_id, extra=said)
            return _problem_response(_problem_of_unexpected(error))

    def _etag(self, model_id: str, body: BaseModel) -> str:
        content = body.canonical() if isinstance(body, RenderRequest) else body.model_dump_json().encode()
        separator = b"\0"
        parts = [_ENCODING_VERSION, model_id.encode(), self._cache.etag(model_id).encode(), content]
        return f'"{hashlib.sha256(separator.join(parts)).hexdigest()[:32]}"'

    async def _image(
        self, request: Request, model_id: str, body: RenderRequest, headers: dict[str, str]
    ) -> Response:
        def work() -> Response:
            from splatmill_worker.render_service.encoding import render_image

            image = render_image(self._cache.get(model_id), body)
            return Response(image.data, media_type=image.media_type, headers=headers | dict(image.headers))

        return await self._queue.run(work, request.is_disconnected, _client(request))

    async def _video(
        self, request: Request, model_id: str, body: OrbitRequest, headers: dict[str, str]
    ) -> Response:
        return await self._frames(
            request, model_id, OrbitFrames(orbit=body, first=0, count=body.frames), headers
        )

    async def _frames(
        self, request: Request, model_id: str, body: OrbitFrames, headers: dict[str, str]
    ) -> Response:
        """Render frame by frame, so that images can be rendered in between, and none is rendered for a client that has
        left.

        The model is not held between two turns, so that all models keep to the bytes of the cache. A turn that had to
        read it continues for as long as that took: videos of models that do not fit together would else read them anew
        for each frame.
        """
        from splatmill_worker.film import Film
        from splatmill_worker.render_service.encoding import render_frame

        orbit = body.orbit
        cameras = await self._queue.run(
            lambda: self._orbit_cameras(self._cache.get(model_id), orbit),
            request.is_disconnected,
            _client(request),
        )
        waiting = deque(cameras[body.first : body.first + body.count])
        path = scratch(request) / "orbit.mp4"
        film = Film(path, orbit.width, orbit.height, orbit.fps)

        def add_some() -> None:
            began = time.monotonic()
            model = self._cache.get(model_id)
            read = time.monotonic()
            film.add(render_frame(model, waiting.popleft(), orbit.background))
            while waiting and time.monotonic() - read < read - began:
                film.add(render_frame(model, waiting.popleft(), orbit.background))

        try:
            while waiting:
                await self._queue.run(add_some, request.is_disconnected, _client(request))
        finally:
            await run_in_threadpool(film.close)
        return FileResponse(path, media_type="video/mp4", headers=headers)

    async def _joined(
        self, request: Request, model_id: str, body: JoinOrbit, headers: dict[str, str]
    ) -> Response:
        """Join in a thread beside what is rendered: nothing is decoded."""
        folder = scratch(request)
        await run_in_threadpool(self._join, model_id, body, folder)
        return FileResponse(folder / "orbit.mp4", media_type="video/mp4", headers=headers)

    def _join(self, model_id: str, body: JoinOrbit, folder: Path) -> None:
        from splatmill_worker.render_service.joining import join

        parts = []
        for entry in self._storage.entries(layout.orbit_frames(model_id, body.orbit)):
            parts.append(folder / f"part-{entry.path.rsplit('/', 1)[-1]}")
            self._storage.download(entry.path, parts[-1])
        frames = join(parts, folder / "orbit.mp4")
        if frames != body.frames:
            raise ValueError(
                f"{frames} frames of the orbit {body.orbit} are stored, and {body.frames} belong to it"
            )

    async def _converted(
        self, request: Request, model_id: str, body: ConversionRequest, headers: dict[str, str]
    ) -> Response:
        """Convert beside what is rendered, and compare picture by picture, so that others come in between."""
        from splatmill_worker.render_service import conversion

        form = DOWNLOADS.get(body.format)
        if form is None:
            raise FormatUnknown(body.format)
        folder = scratch(request)

        def convert() -> tuple[LoadedModel, Path, Gaussians, Conversion]:
            model = self._cache.get(model_id)  # none is held while its conversion waits
            return model, *conversion.convert(model, form, folder, self._storage)

        model, path, back, record = await self._conversions.run(
            convert, request.is_disconnected, _client(request)
        )
        views, what = await run_in_threadpool(conversion.pictures_of, self._storage, model_id)
        behind = await run_in_threadpool(conversion.background_of, self._storage, model_id)
        scores = [
            await self._queue.run(
                partial(conversion.score, self._storage, model, back, view, behind),
                request.is_disconnected,
                _client(request),
            )
            for view in (views if form.readable else [])
        ]
        record = conversion.with_scores(record, scores, what)
        headers = {CONVERSION_HEADER: write_json(record)}
        return FileResponse(path, media_type=form.media_type, headers=headers)

    async def _edited(
        self, request: Request, model_id: str, body: EditModel, headers: dict[str, str]
    ) -> Response:
        from splatmill_worker.render_service.edit import NothingLeft, edit

        path = scratch(request) / "model.ply"
        try:
            edited = await self._queue.run(
                lambda: edit(self._storage, model_id, body, self._backend, path),
                request.is_disconnected,
                _client(request),
            )
        except NothingLeft:
            problem = Problem.of(
                "invalid_request",
                "The edit leaves no Gaussian of the model.",
                advice="Choose a larger box, a lower opacity or a larger size.",
            )
            return _problem_response(problem)
        headers = {EDIT_HEADER: write_json(edited)}
        if body.preview:
            return Response(headers=headers)
        return FileResponse(path, media_type="application/octet-stream", headers=headers)

    async def _mesh(
        self, request: Request, model_id: str, body: MeshRequest, headers: dict[str, str]
    ) -> Response:
        lines = self._meshes.lines(model_id, body, scratch(request), request.is_disconnected)
        return MeshResponse(lines, headers)

    def _orbit_cameras(self, model: LoadedModel, body: OrbitRequest) -> list[Camera]:
        from splatmill_worker.splat.orbit import orbit_cameras

        try:
            text = self._storage.get(layout.model_file(model.id, "cameras.json"))
            stored = ModelCameras.model_validate_json(text)
        except (FileNotFoundError, ValidationError):
            stored = None
        return list(orbit_cameras(stored, model.gaussians, body))


def _client(request: Request) -> str:
    """Return who takes turns with others: the client of the API, or all who do not come through it."""
    return request.headers.get(rendering.CLIENT_HEADER, "")


def _matches(header: str | None, etag: str) -> bool:
    """Return whether an `If-None-Match` header names this ETag (weak comparison, RFC 9110, section 13.1.2)."""
    if header is None:
        return False
    known = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    return etag in known or "*" in known


def _problem_response(problem: Problem, headers: dict[str, str] | None = None) -> Response:
    return Response(
        problem.model_dump_json(exclude_none=True),
        status_code=problem.status,
        media_type=PROBLEM_MEDIA_TYPE,
        headers=headers,
    )


def _problem_of_validation(error: ValidationError) -> Problem:
    errors = error.errors(include_url=False, include_input=False, include_context=False)
    first = errors[0]
    where = ".".join(str(part) for part in first["loc"]) or "the body"
    of_camera = bool(first["loc"]) and first["loc"][0] == "camera"
    of_size = first["loc"][-1:] in (("width",), ("height",))
    code = "size_out_of_range" if of_size else "camera_invalid" if of_camera else "invalid_request"
    message = first["msg"].removeprefix("Value error, ").rstrip(".")
    return Problem.of(
        code,
        f"The request does not match the schema, at {where}: {message}.",
        facts={"errors": [dict(each) for each in errors]},
    )


def _problem_of_unexpected(error: Exception) -> Problem:
    lines = str(error).strip().splitlines() or ["no message"]
    return Problem.of(
        "render_failed",
        f"The image could not be rendered: {type(error).__name__}: {lines[0][:300]}",
        advice="Request a smaller image, or look for the cause in the renderer's log.",
    )

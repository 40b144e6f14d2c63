"""A finished model on the server: its files, its cameras, and images rendered from it."""

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack
from urllib.parse import quote

import httpx

from splatmill.errors import WaitTimeout, valid_request
from splatmill.files import atomic_write
from splatmill.schema import (
    Box,
    CameraSpec,
    ChangeLabels,
    ChangePresentation,
    Edited,
    EditModel,
    MeshFormat,
    Model,
    ModelCamera,
    ModelCameras,
    ModelDownload,
    ModelDownloads,
    OrbitRequest,
    Presentation,
    RenderRequest,
    Selection,
)
from splatmill.sdk.arguments import MeshArguments, OrbitArguments, PresentationArguments, RenderArguments
from splatmill.sdk.meshes import AsyncMeshes
from splatmill.sdk.orbits import AsyncOrbits
from splatmill.sdk.shares import AsyncShares
from splatmill.transfer.connection import Connection, read_answer
from splatmill.transfer.downloads import AnyPath, OnBytes, download, target_of
from splatmill.transfer.uploads import OnProgress

# Longer than the server waits for its renderer, so that the server's problem arrives before this timeout.
RENDER_TIMEOUT = httpx.Timeout(30.0, read=150.0)
# Without a GPU, hundreds of frames take minutes, and the response begins when the video is complete.
ORBIT_TIMEOUT = httpx.Timeout(30.0, read=900.0)


def label_changes(tags: Sequence[str] | None, favourite: bool | None) -> dict[str, Any]:
    """Return the request that changes the tags and the star; None leaves one as it is. Raises InvalidRequest."""
    changes = {name: value for name, value in (("tags", tags), ("favourite", favourite)) if value is not None}
    return valid_request(ChangeLabels, changes).model_dump(mode="json", exclude_unset=True)


class AsyncModelHandle:
    """A finished model on the server."""

    def __init__(self, connection: Connection, model: Model) -> None:
        self.connection = connection
        self.model = model
        """The record of the model."""
        self.shares = AsyncShares(connection, model.id)
        self.orbits = AsyncOrbits(connection, model.id)
        self.meshes = AsyncMeshes(connection, model.id)

    @property
    def id(self) -> str:
        """The id of the model."""
        return self.model.id

    async def download(
        self, path: AnyPath, *, file: str = "model.ply", on_bytes: OnBytes | None = None
    ) -> Path:
        """Download a file of the model to `path`, a file or an existing folder, and return the path written.

        A partial download is resumed. `on_bytes` is called with the bytes received and the size, where it is known.
        Raises DownloadFailed, ConnectionFailed, a subclass of `Refused`, or OSError.
        """
        digest = next((entry.sha256 for entry in self.model.files if entry.name == file), None)
        return await download(
            self.connection,
            f"/v1/models/{self.id}/files/{file}",
            target_of(path, file),
            sha256=digest,
            on_bytes=on_bytes,
        )

    async def formats(self) -> list[ModelDownload]:
        """Return the file formats in which the model can be downloaded, with bytes and quality where they are known."""
        response = await self.connection.request("GET", f"/v1/models/{self.id}/formats")
        return read_answer(ModelDownloads, response).formats

    async def download_as(self, format: str, path: AnyPath, *, on_bytes: OnBytes | None = None) -> Path:
        """Download the model in another file format, such as "sog", to `path`, a file or an existing folder.

        The first download in a format waits until the server has converted the model. Returns the path written.
        Raises NotFound for an unknown format, DownloadFailed, ConnectionFailed, a subclass of `Refused`, or OSError.
        """
        address = f"/v1/models/{self.id}/download/{quote(format, safe='')}"
        # The conversion comes first: downloads are begun again when no byte has come for some seconds.
        first = {"Range": "bytes=0-0"}
        await self.connection.request(
            "GET", address, headers=first, repeatable=True, costly=True, timeout=ORBIT_TIMEOUT
        )
        return await download(
            self.connection, address, target_of(path, f"{self.id}.{format}"), on_bytes=on_bytes
        )

    async def rename(self, name: str | None) -> Model:
        """Name the model, and its job with it; None takes the name away. Returns the record."""
        return await self._change({"name": name})

    async def label(self, *, tags: Sequence[str] | None = None, favourite: bool | None = None) -> Model:
        """Give the model, and its job with it, these tags in place of those it has, or a star. Returns the record.

        None leaves them as they are. Raises InvalidRequest for more than 12 tags, or ones over 40 characters.
        """
        return await self._change(label_changes(tags, favourite))

    async def _change(self, labels: Mapping[str, Any]) -> Model:
        response = await self.connection.request(
            "PATCH", f"/v1/models/{self.id}", json=labels, repeatable=True
        )
        self.model = read_answer(Model, response)
        return self.model

    async def delete(self) -> None:
        """Delete the model with its job, its report and its files. The capture is kept."""
        await self.connection.request("DELETE", f"/v1/jobs/{self.model.job}")

    async def cameras(self) -> list[ModelCamera]:
        """Return the cameras of the capture in the coordinates of the model; `split` marks the held-out ones."""
        response = await self.connection.request("GET", f"/v1/models/{self.id}/cameras")
        return read_answer(ModelCameras, response).cameras

    async def presentation(self) -> Presentation:
        """Return how the model is shown to people: its start view, scale, measurements and annotations."""
        response = await self.connection.request("GET", f"/v1/models/{self.id}/presentation")
        return read_answer(Presentation, response)

    async def present(self, **changes: Unpack[PresentationArguments]) -> Presentation:
        """Change how the model and its links are shown to people, and return the whole of it.

        `changes` are fields of `Presentation`; those that are left out stay as they are, and None takes the start view
        or the scale away. Another start view makes the server render the picture `poster.jpg`.

        Raises InvalidRequest for values that are not valid.
        """
        request = valid_request(ChangePresentation, changes)
        response = await self.connection.request(
            "PATCH",
            f"/v1/models/{self.id}/presentation",
            json=request.model_dump(mode="json", exclude_unset=True),
            repeatable=True,
            costly=True,
            timeout=RENDER_TIMEOUT,
        )
        return read_answer(Presentation, response)

    async def render(
        self, camera: CameraSpec | Mapping[str, Any], **options: Unpack[RenderArguments]
    ) -> bytes:
        """Render an image from `camera`, and return the bytes of the file.

        `options` are output, format, background and quality of `RenderRequest`. Raises InvalidRequest for a camera or
        options that are not valid.
        """
        request = valid_request(RenderRequest, {**options, "camera": camera}, "camera_invalid")
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/render",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            costly=True,
            timeout=RENDER_TIMEOUT,
        )
        return response.content

    async def orbit(
        self,
        path: AnyPath,
        *,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
        keep: bool = True,
        **options: Unpack[OrbitArguments],
    ) -> Path:
        """Render a video (MP4) that circles the scene or follows a camera path, write it to `path`, and return that.

        `options` are the fields of `OrbitRequest`. `timeout` is the number of seconds to wait for the video; left out,
        as long as it takes. `on_progress` is called with the number of frames that are rendered.

        keep: keep the video with the model, where the same options find it again, and go on after a restart of the
        server. False renders it for this call alone, which a key with the scope `read` may do too; it is waited for as
        long as the server does by default.

        Raises InvalidRequest for options that are not valid. After the timeout it raises WaitTimeout, and the rendering
        continues; without `keep` it raises ConnectionFailed, and the rendering ends.
        """
        target = target_of(path, "orbit.mp4")
        if not keep:
            request = valid_request(OrbitRequest, options)
            return await self._orbit_for_this_call(target, timeout, request)
        begun = await self.orbits.start(**options)
        try:
            async with asyncio.timeout(timeout) as limit:
                await self.orbits.wait(begun.id, on_progress)
        except TimeoutError as error:
            if not limit.expired() or timeout is None:
                raise
            raise WaitTimeout(begun.id, "not whole", timeout, "orbit video") from error
        return await self.orbits.download(begun.id, target)

    async def _orbit_for_this_call(self, target: Path, timeout: float | None, request: OrbitRequest) -> Path:
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/orbit",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            costly=True,
            timeout=ORBIT_TIMEOUT if timeout is None else httpx.Timeout(30.0, read=timeout),
        )
        atomic_write(target, response.content)
        return target

    async def mesh(
        self,
        path: AnyPath,
        *,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
        **options: Unpack[MeshArguments],
    ) -> Path:
        """Make a mesh of the model: triangles with a colour at each vertex. Write it to `path`, and return that.

        `options` are the fields of `MeshRequest`; the format is that of the suffix of `path`, if it has one of them.
        `timeout` is the number of seconds to wait for the mesh; left out, as long as it takes. `on_progress` is called
        with what is being done. The server keeps the mesh with the model, where the same options find it again.

        Raises InvalidRequest for options that are not valid. After the timeout it raises WaitTimeout, and the server
        continues.
        """
        suffix = Path(path).suffix.lower().removeprefix(".")
        if suffix in MeshFormat.__members__:
            options.setdefault("format", MeshFormat(suffix))
        begun = await self.meshes.start(**options)
        try:
            async with asyncio.timeout(timeout) as limit:
                await self.meshes.wait(begun.id, on_progress)
        except TimeoutError as error:
            if not limit.expired() or timeout is None:
                raise
            raise WaitTimeout(begun.id, "not whole", timeout, "mesh") from error
        return await self.meshes.download(begun.id, path)

    async def edit(
        self,
        *,
        box: Box | Mapping[str, Sequence[float]] | None = None,
        min_opacity: float | None = None,
        max_size: float | None = None,
        selection: Selection | Mapping[str, Any] | None = None,
        name: str | None = None,
        preview: bool = False,
    ) -> Edited:
        """Make a new model of a part of this one, which is kept, and return what that does to the held-out photos.

        box: keep the Gaussians whose centre lies in it: `{"min": [x, y, z], "max": [x, y, z]}` in units of the model.
        min_opacity: keep the Gaussians of at least this opacity, between 0 and 1.
        max_size: keep the Gaussians whose standard deviation is at most this along every axis, in units of the model.
        selection: leave out the Gaussians in it, which was drawn on views of the model.
        name: of the new model; left out, that of this one.
        preview: only measure; no model is made.

        At least one of box, min_opacity, max_size and selection is needed. `model` of the returned record is the id of
        the new model, None for a preview. Raises InvalidRequest for values that are not valid, and for an edit that
        leaves nothing.
        """
        values = {
            "box": box,
            "min_opacity": min_opacity,
            "max_size": max_size,
            "selection": selection,
            "name": name,
            "preview": preview,
        }
        request = valid_request(EditModel, values)
        # Repeated after a lost answer, it would make a second model, so only a preview is.
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/edits",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=preview,
            costly=True,
            timeout=ORBIT_TIMEOUT,
        )
        return read_answer(Edited, response)


async def find_model(connection: Connection, model_id: str) -> AsyncModelHandle:
    """Return the finished model with this id. Raises NotFound, or Conflict while its job runs."""
    response = await connection.request("GET", f"/v1/models/{model_id}")
    return AsyncModelHandle(connection, read_answer(Model, response))

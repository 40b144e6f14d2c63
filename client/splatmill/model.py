"""A finished model on the server: its files, its cameras, and images rendered from it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import httpx
from pydantic import ValidationError

from splatmill.arguments import OrbitArguments, RenderArguments
from splatmill.connection import Connection, read_answer
from splatmill.downloads import AnyPath, OnBytes, download, target_of
from splatmill.errors import invalid_request
from splatmill.files import atomic_write
from splatmill.schema import CameraSpec, Model, ModelCamera, ModelCameras, OrbitRequest, RenderRequest

# Longer than the server waits for its renderer, so that the server's problem arrives before this timeout.
RENDER_TIMEOUT = httpx.Timeout(30.0, read=150.0)
# Without a GPU, hundreds of frames take minutes, and the response begins when the video is complete.
ORBIT_TIMEOUT = httpx.Timeout(30.0, read=900.0)


class AsyncModelHandle:
    """A finished model on the server."""

    def __init__(self, connection: Connection, model: Model) -> None:
        self.connection = connection
        self.model = model

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

    async def delete(self) -> None:
        """Delete the model with its job, its report and its files. The capture is kept."""
        await self.connection.request("DELETE", f"/v1/jobs/{self.model.job}")

    async def cameras(self) -> list[ModelCamera]:
        """Return the cameras of the capture in the coordinates of the model; `split` marks the held-out ones."""
        response = await self.connection.request("GET", f"/v1/models/{self.id}/cameras")
        return read_answer(ModelCameras, response).cameras

    async def render(
        self, camera: CameraSpec | Mapping[str, Any], **options: Unpack[RenderArguments]
    ) -> bytes:
        """Render an image from `camera`, and return the bytes of the file.

        `options` are output, format, background and quality of `RenderRequest`. Raises InvalidRequest for a camera or
        options that are not valid.
        """
        try:
            request = RenderRequest.model_validate({**options, "camera": camera})
        except ValidationError as error:
            raise invalid_request(error, "camera_invalid") from error
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
        self, path: AnyPath, *, timeout: float | None = None, **options: Unpack[OrbitArguments]
    ) -> Path:
        """Render a video (MP4) that circles the scene, write it to `path`, and return the path written.

        `options` are the fields of `OrbitRequest`. `timeout` is the number of seconds to wait for the video; left out,
        as long as the server does by default. Raises InvalidRequest for options that are not valid, and
        ConnectionFailed after the timeout.
        """
        try:
            request = OrbitRequest.model_validate(options)
        except ValidationError as error:
            raise invalid_request(error) from error
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/orbit",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            costly=True,
            timeout=ORBIT_TIMEOUT if timeout is None else httpx.Timeout(30.0, read=timeout),
        )
        target = target_of(path, "orbit.mp4")
        atomic_write(target, response.content)
        return target


async def find_model(connection: Connection, model_id: str) -> AsyncModelHandle:
    """Return the finished model with this id. Raises NotFound, or Conflict while its job runs."""
    response = await connection.request("GET", f"/v1/models/{model_id}")
    return AsyncModelHandle(connection, read_answer(Model, response))

"""A finished model on the server: its files, its cameras, and pictures of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx
from pydantic import ValidationError

from splatmill.connection import Connection, read_answer
from splatmill.downloads import AnyPath, OnBytes, download, target_of
from splatmill.errors import invalid
from splatmill.files import atomic_write
from splatmill.schema import CameraSpec, Model, ModelCamera, ModelCameras, OrbitRequest, RenderRequest

# A little longer than the server waits for its renderer, so that its sentence arrives instead of ours.
RENDER_TIMEOUT = httpx.Timeout(30.0, read=150.0)
# Hundreds of frames on a machine without a GPU take minutes, and the answer begins when the video is whole.
ORBIT_TIMEOUT = httpx.Timeout(30.0, read=900.0)


class AsyncModelHandle:
    """A finished model on the server."""

    def __init__(self, connection: Connection, model: Model) -> None:
        self.connection = connection
        self.model = model

    @property
    def id(self) -> str:
        """The model's id."""
        return self.model.id

    async def download(
        self, path: AnyPath, *, file: str = "model.ply", on_bytes: OnBytes | None = None
    ) -> Path:
        """Write one of the model's files to `path` (a file, or a folder that exists), whole or not at all."""
        digest = next((entry.sha256 for entry in self.model.files if entry.name == file), None)
        return await download(
            self.connection,
            f"/v1/models/{self.id}/files/{file}",
            target_of(path, file),
            sha256=digest,
            on_bytes=on_bytes,
        )

    async def cameras(self) -> list[ModelCamera]:
        """The cameras of the capture in the model's world, held-out ones marked `test`."""
        response = await self.connection.request("GET", f"/v1/models/{self.id}/cameras")
        return read_answer(ModelCameras, response).cameras

    async def render(self, camera: CameraSpec | Mapping[str, Any], **wishes: Any) -> bytes:
        """The picture from `camera`; `wishes` are `output`, `format`, `background` and `quality` of RenderRequest."""
        try:
            request = RenderRequest.model_validate({"camera": camera} | wishes)
        except ValidationError as error:
            raise invalid(error, "camera_invalid") from error
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/render",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            timeout=RENDER_TIMEOUT,
        )
        return response.content

    async def orbit(self, path: AnyPath, **wishes: Any) -> Path:
        """Write a video (MP4) that circles the scene to `path`; `wishes` are the fields of OrbitRequest."""
        try:
            request = OrbitRequest.model_validate(wishes)
        except ValidationError as error:
            raise invalid(error) from error
        response = await self.connection.request(
            "POST",
            f"/v1/models/{self.id}/orbit",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            timeout=ORBIT_TIMEOUT,
        )
        target = target_of(path, "orbit.mp4")
        atomic_write(target, response.content)
        return target


async def find_model(connection: Connection, model_id: str) -> AsyncModelHandle:
    """A finished model by its id; raises NotFound, or Conflict while its job runs."""
    response = await connection.request("GET", f"/v1/models/{model_id}")
    return AsyncModelHandle(connection, read_answer(Model, response))

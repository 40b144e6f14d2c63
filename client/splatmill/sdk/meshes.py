"""The meshes of a model: `AsyncModelHandle.meshes` and `ModelHandle.meshes`."""

import asyncio
from pathlib import Path
from typing import Unpack

from splatmill.errors import error_for, valid_request
from splatmill.schema import Mesh, MeshList, MeshRequest, Progress
from splatmill.sdk.arguments import MeshArguments
from splatmill.transfer.connection import Connection, read_answer
from splatmill.transfer.downloads import AnyPath, download, target_of
from splatmill.transfer.uploads import OnProgress

_POLL_SECONDS = 0.5
_LONGEST_POLL = 3.0


class AsyncMeshes:
    """Starts, follows, lists and deletes the meshes of a model, which the server makes in the background."""

    def __init__(self, connection: Connection, model_id: str) -> None:
        self._connection = connection
        self._path = f"/v1/models/{model_id}/meshes"

    async def start(self, **options: Unpack[MeshArguments]) -> Mesh:
        """Let the server make a mesh in the background, and keep it with the model.

        `options` are the fields of `MeshRequest`. The same options return the same mesh, also one that is whole. Raises
        InvalidRequest for options that are not valid, and Conflict where there are too many meshes.
        """
        content = valid_request(MeshRequest, options).model_dump(mode="json", exclude_none=True)
        response = await self._connection.request("POST", self._path, json=content, repeatable=True)
        return read_answer(Mesh, response)

    async def get(self, mesh_id: str) -> Mesh:
        """Return a mesh: its state, what is being done, and at the end its triangles and size, or the problem.

        Raises NotFound for a mesh that does not exist.
        """
        return read_answer(Mesh, await self._connection.request("GET", f"{self._path}/{mesh_id}"))

    async def wait(self, mesh_id: str, on_progress: OnProgress | None = None) -> Mesh:
        """Wait until a mesh is whole, and return it.

        on_progress: called with what is being done.

        Raises a subclass of `Refused` with the problem of a mesh that has failed, and NotFound for one that somebody
        deletes meanwhile.
        """
        pause = _POLL_SECONDS
        while True:
            record = await self.get(mesh_id)
            if on_progress is not None:
                on_progress(record.progress or Progress(stage=record.state))
            if record.problem is not None:
                raise error_for(record.problem)
            if record.state.final:
                return record
            await asyncio.sleep(pause)
            pause = min(pause * 1.5, _LONGEST_POLL)

    async def list(self) -> list[Mesh]:
        """Return the meshes of the model, newest first."""
        return read_answer(MeshList, await self._connection.request("GET", self._path)).meshes

    async def download(self, mesh_id: str, path: AnyPath) -> Path:
        """Download a mesh that is whole to `path`, a file or an existing folder, and return the path written.

        Raises Conflict for a mesh that is not whole, NotFound, DownloadFailed, ConnectionFailed or OSError.
        """
        record = await self.get(mesh_id)
        target = target_of(path, f"mesh.{record.request.format}")
        return await download(self._connection, f"{self._path}/{mesh_id}/file", target)

    async def delete(self, mesh_id: str) -> None:
        """Delete a mesh; one that is not whole is not made any further.

        Raises NotFound for a mesh that does not exist.
        """
        await self._connection.request("DELETE", f"{self._path}/{mesh_id}")

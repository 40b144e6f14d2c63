"""Meshes of models: made by the renderer in the background, which says what it does meanwhile, and kept with the model.

After a restart, a mesh is begun again.
"""

import time
from collections.abc import AsyncIterator
from datetime import UTC, datetime

import httpx
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.rendering import MeshLine
from splatmill.backplane.storage import layout
from splatmill.schema import KeptState, Mesh, MeshRequest
from splatmill_server.access.caller import Caller
from splatmill_server.background.kept import Delayed, KeptOfModels, digest
from splatmill_server.space.quota import Arrival

MOST_OF_A_LINE = 1 << 16
"""Bytes of a line of the renderer at most."""

_WRITE_SECONDS = 1.0
"""Seconds between two writes of a record that only say how far a mesh is."""

_VERSION = "1"
"""Part of each id, to be raised when the same request gives another mesh than before."""


class Meshes(KeptOfModels[Mesh]):
    """All operations on meshes."""

    kind = "meshes"
    code = "mesh"
    noun = "mesh"
    nouns = "meshes"
    failure = "mesh_failed"
    record = Mesh
    file = "file"
    most_unfinished = 5
    most_of_model = 20

    async def create(self, model_id: str, request: MeshRequest, who: Caller) -> Mesh:
        """Return the mesh of a request, which is made in the background if it is not there.

        Raises the problems of `KeptOfModels._begin`.
        """

        def new(mesh_id: str) -> Mesh:
            return Mesh(
                id=mesh_id,
                model=model_id,
                request=request,
                state=KeptState.queued,
                created_at=datetime.now(UTC),
            )

        def id_of(etag: str) -> str:
            return digest([_VERSION, etag, request.model_dump_json(exclude_none=True)])

        return await self._begin(model_id, id_of, new, who)

    async def _next(self, name: str, record: Mesh) -> Mesh | None:
        """Have the mesh made and stored, and its record say meanwhile what is done."""
        path = layout.mesh_file(record.model, record.id)
        made = record.model_copy(update={"state": KeptState.running})

        async def store(answer: httpx.Response, room: Arrival) -> None:
            nonlocal made
            arriving, written = _Arriving(answer.aiter_raw()), 0.0
            while (text := await arriving.line()) is not None:
                line = MeshLine.model_validate_json(text)
                if line.problem is not None:
                    raise self._refusal(line.problem.model_dump_json().encode())
                if line.facts is not None:
                    made = made.model_copy(update={"facts": line.facts, "progress": None})
                    await run_in_threadpool(room.announce, str(line.bytes))
                    await self._storage.stream_put(path, room.counted(arriving.left()))
                    return
                if time.monotonic() - written > _WRITE_SECONDS:
                    made = made.model_copy(update={"progress": line.progress})
                    await run_in_threadpool(self._write, name, made)
                    written = time.monotonic()
            detail = "The renderer ended its answer before there was a mesh."
            raise Delayed(self._failed_because(detail), counts=True)

        await self._ask(name, rendering.mesh_path(record.model), record.request, store)
        return await self._whole(made, path)


class _Arriving:
    """The answer of the renderer: lines, then the bytes of a file."""

    def __init__(self, chunks: AsyncIterator[bytes]) -> None:
        self._chunks = chunks
        self._read = b""

    async def line(self) -> bytes | None:
        """Return the next line; None where the answer ends, or is none of lines."""
        while b"\n" not in self._read:
            if len(self._read) > MOST_OF_A_LINE or not (chunk := await anext(self._chunks, b"")):
                return None
            self._read += chunk
        line, self._read = self._read.split(b"\n", 1)
        return line

    async def left(self) -> AsyncIterator[bytes]:
        """Return what follows the lines."""
        yield self._read
        async for chunk in self._chunks:
            yield chunk

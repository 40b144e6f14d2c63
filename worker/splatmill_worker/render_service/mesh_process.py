"""Meshes of stored models, for the renderer: the program `mesh-file` in a process of its own, and what it says.

Its work takes minutes in native code that nothing interrupts: as a process, it lets views be rendered meanwhile, ends
at once when nobody waits for it any more, and takes nothing with it when the machine runs out of memory.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing, suppress
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from splatmill.backplane.rendering import MeshLine
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import MeshRequest, Problem, Progress

REPEAT_SECONDS = 5.0
"""Seconds after which a line of progress is sent again, so that the connection is not silent."""

LOOK_SECONDS = 0.5
"""Seconds between two looks whether somebody still waits for the mesh."""

CHUNK = 1 << 20  # bytes of the file that are sent at a time

_BESIDE = ("cameras.json", "report.json")
"""Files beside a model that the program reads."""


class MeshResponse(StreamingResponse):
    """A stream that ends its generator, and with it the process, however the request ends."""

    def __init__(self, lines: AsyncGenerator[bytes], headers: dict[str, str]) -> None:
        super().__init__(lines, media_type="application/octet-stream", headers=headers)
        self._lines = lines

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            await self._lines.aclose()


class MeshMaker:
    """Makes one mesh at a time.

    backend: the kernels to render with; None means those of the CPU.
    """

    def __init__(self, storage: Storage, backend: str | None) -> None:
        self._storage = storage
        self._backend = backend
        self._turn = asyncio.Lock()

    async def lines(
        self, model_id: str, request: MeshRequest, folder: Path, gone: Callable[[], Awaitable[bool]]
    ) -> AsyncGenerator[bytes]:
        """Yield each `MeshLine` of a mesh, and then the bytes of its file.

        folder: a temporary folder.
        gone: returns whether nobody waits for the mesh any more, which ends it.
        """
        waiting = MeshLine(progress=Progress(stage="waiting for another mesh")).encoded()
        while self._turn.locked():
            yield waiting
            with suppress(TimeoutError):
                async with asyncio.timeout(REPEAT_SECONDS):
                    await self._turn.acquire()
                    self._turn.release()
            if await gone():
                return
        async with self._turn:
            out = folder / f"mesh.{request.format}"
            try:
                model = await run_in_threadpool(self._local, model_id, folder)
            except StorageError as error:
                yield MeshLine(problem=Problem.of("storage_unavailable", error.summary)).encoded()
                return
            async with aclosing(self._made(model, request, out, gone)) as made:
                async for line in made:
                    yield line.encoded()
                    if line.facts is not None:
                        with out.open("rb") as file:
                            while chunk := await run_in_threadpool(file.read, CHUNK):
                                yield chunk

    async def _made(
        self, model: Path, request: MeshRequest, out: Path, gone: Callable[[], Awaitable[bool]]
    ) -> AsyncGenerator[MeshLine]:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "splatmill_worker", "mesh-file", "--out", str(out)),
            *("--faces", str(request.faces), "--parent", str(os.getpid())),
            *(("--voxel", repr(request.voxel)) if request.voxel is not None else ()),
            *(("--box", request.box.model_dump_json()) if request.box is not None else ()),
            *(("--texture", str(request.texture)) if request.texture is not None else ()),
            *(("--backend", self._backend) if self._backend is not None else ()),
            *("--", str(model)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
        )
        last = MeshLine(progress=Progress(stage="reading the model"))
        try:
            async with aclosing(_lines(process, gone)) as texts:
                async for text in texts:
                    if text is not None:
                        last = MeshLine.model_validate_json(text)
                    if last.facts is not None:
                        last.bytes = out.stat().st_size
                    yield last
                    if last.progress is None:
                        return
            if not await gone():
                yield MeshLine(problem=_ended(await process.wait()))
        finally:
            with suppress(ProcessLookupError):
                process.kill()
            await asyncio.shield(process.wait())

    def _local(self, model_id: str, folder: Path) -> Path:
        """The path of a model file with what is beside it, in storage or copied to a folder."""
        name = layout.model_file(model_id, "model.ply")
        if (local := self._storage.local_path(name)) is not None:
            return local
        self._storage.download(name, folder / "model.ply")
        for beside in _BESIDE:
            with suppress(FileNotFoundError):
                self._storage.download(layout.model_file(model_id, beside), folder / beside)
        return folder / "model.ply"


async def _lines(
    process: asyncio.subprocess.Process, gone: Callable[[], Awaitable[bool]]
) -> AsyncGenerator[bytes | None]:
    """Yield what a process writes line by line, until it ends or nobody waits; None where it is silent for long."""
    assert process.stdout is not None
    silent = 0.0
    reading = asyncio.ensure_future(process.stdout.readline())
    try:
        while not await gone():
            if not (await asyncio.wait({reading}, timeout=LOOK_SECONDS))[0]:
                silent += LOOK_SECONDS
                if silent >= REPEAT_SECONDS:
                    yield None
                    silent = 0.0
                continue
            if not (line := reading.result()):
                return
            yield line
            silent = 0.0
            reading = asyncio.ensure_future(process.stdout.readline())
    finally:
        reading.cancel()


def _ended(status: int) -> Problem:
    """The problem of a process that ended without a mesh."""
    if status == -signal.SIGKILL:
        return Problem.of(
            "out_of_memory",
            "The process that made the mesh was ended, as happens where the machine has no memory left.",
            advice="Ask for a mesh of a smaller box or of larger voxels, or try again when the machine is less busy.",
        )
    return Problem.of(
        "mesh_failed",
        f"The process that made the mesh ended with status {status}.",
        advice="Try again. If the problem persists, read the log of the renderer.",
    )

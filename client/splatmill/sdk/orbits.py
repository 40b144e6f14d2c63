"""The orbit videos of a model: `AsyncModelHandle.orbits` and `ModelHandle.orbits`."""

import asyncio
from pathlib import Path
from typing import Unpack

from splatmill.errors import error_for, valid_request
from splatmill.schema import Orbit, OrbitList, OrbitRequest, Progress
from splatmill.sdk.arguments import OrbitArguments
from splatmill.transfer.connection import Connection, read_answer
from splatmill.transfer.downloads import AnyPath, download, target_of
from splatmill.transfer.uploads import OnProgress

_POLL_SECONDS = 0.2
_LONGEST_POLL = 2.0


class AsyncOrbits:
    """Starts, follows, lists and deletes the videos that circle a model, which the server renders in the background."""

    def __init__(self, connection: Connection, model_id: str) -> None:
        self._connection = connection
        self._path = f"/v1/models/{model_id}/orbits"

    async def start(self, **options: Unpack[OrbitArguments]) -> Orbit:
        """Let the server render a video in the background, and keep it with the model.

        `options` are the fields of `OrbitRequest`. The same options return the same video, also one that is whole.
        Raises InvalidRequest for options that are not valid, and Conflict where there are too many videos.
        """
        content = valid_request(OrbitRequest, options).model_dump(mode="json", exclude_none=True)
        response = await self._connection.request("POST", self._path, json=content, repeatable=True)
        return read_answer(Orbit, response)

    async def get(self, orbit_id: str) -> Orbit:
        """Return a video: its state, the frames that are rendered, and at the end its size or the problem.

        Raises NotFound for a video that does not exist.
        """
        return read_answer(Orbit, await self._connection.request("GET", f"{self._path}/{orbit_id}"))

    async def wait(self, orbit_id: str, on_progress: OnProgress | None = None) -> Orbit:
        """Wait until a video is whole, and return it.

        on_progress: called with the number of frames that are rendered.

        Raises a subclass of `Refused` with the problem of a video that has failed, and NotFound for one that somebody
        deletes meanwhile.
        """
        pause = _POLL_SECONDS
        while True:
            record = await self.get(orbit_id)
            if on_progress is not None:
                on_progress(Progress(stage="rendering", done=record.frames_done, total=record.frames))
            if record.problem is not None:
                raise error_for(record.problem)
            if record.state.final:
                return record
            await asyncio.sleep(pause)
            pause = min(pause * 1.5, _LONGEST_POLL)

    async def list(self) -> list[Orbit]:
        """Return the videos of the model, newest first."""
        return read_answer(OrbitList, await self._connection.request("GET", self._path)).orbits

    async def download(self, orbit_id: str, path: AnyPath) -> Path:
        """Download a video that is whole to `path`, a file or an existing folder, and return the path written.

        Raises Conflict for a video that is not whole, NotFound, DownloadFailed, ConnectionFailed or OSError.
        """
        return await download(
            self._connection, f"{self._path}/{orbit_id}/video", target_of(path, "orbit.mp4")
        )

    async def delete(self, orbit_id: str) -> None:
        """Delete a video; one that is not whole is not rendered any further.

        Raises NotFound for a video that does not exist.
        """
        await self._connection.request("DELETE", f"{self._path}/{orbit_id}")

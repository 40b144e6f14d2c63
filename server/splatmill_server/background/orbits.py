"""Orbit videos: rendered in the background, a part at a time, and kept in storage with their model.

After a restart, a video continues with the first frame that is not stored.
"""

from collections.abc import Awaitable, Callable
from datetime import UTC, datetime

import httpx
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.schema import JoinOrbit, KeptState, Orbit, OrbitFrames, OrbitRequest
from splatmill_server.access.caller import Caller
from splatmill_server.background.kept import KeptOfModels, digest
from splatmill_server.space.quota import Arrival

PART_PIXELS = 16_000_000
PART_FRAMES = (8, 48)
"""Pixels of all frames of a part, and its smallest and largest number of frames.

At 640 x 480, a part takes a second of two cores. It is what a restart repeats, and each begins with a frame that refers
to none before it, so that smaller parts make a larger video.
"""

_VERSION = "1"
"""Part of each id, to be raised when the same request gives another video than before."""


class Orbits(KeptOfModels[Orbit]):
    """All operations on orbit videos."""

    kind = "orbits"
    code = "orbit"
    noun = "orbit video"
    nouns = "orbit videos"
    failure = "render_failed"
    record = Orbit
    file = "video"
    most_unfinished = 20
    most_of_model = 100

    async def create(self, model_id: str, request: OrbitRequest, who: Caller) -> Orbit:
        """Return the orbit video of a request, which is rendered in the background if it is not there.

        Raises the problems of `KeptOfModels._begin`.
        """

        def new(orbit_id: str) -> Orbit:
            return Orbit(
                id=orbit_id,
                model=model_id,
                request=request,
                state=KeptState.queued,
                frames=request.frames,
                created_at=datetime.now(UTC),
            )

        return await self._begin(model_id, lambda etag: _id_of(etag, request), new, who)

    async def _next(self, name: str, record: Orbit) -> Orbit | None:
        """Have the next part rendered, or the video made of all."""
        model_id, first = record.model, record.frames_done
        if first < record.frames:
            count = min(_part_frames(record.request), record.frames - first)
            body = OrbitFrames(orbit=record.request, first=first, count=count)
            path = layout.orbit_frames(model_id, record.id, first)
            await self._ask(name, rendering.orbit_frames_path(model_id), body, self._stored_at(path))
            return record.model_copy(update={"state": KeptState.running, "frames_done": first + count})
        path = layout.orbit_video(model_id, record.id)
        whole = JoinOrbit(orbit=record.id, frames=record.frames)
        await self._ask(name, rendering.orbit_join_path(model_id), whole, self._stored_at(path))
        return await self._whole(record, path)

    def _stored_at(self, path: str) -> Callable[[httpx.Response, Arrival], Awaitable[None]]:
        async def store(answer: httpx.Response, room: Arrival) -> None:
            await run_in_threadpool(room.announce, answer.headers.get("content-length"))
            await self._storage.stream_put(path, room.counted(answer.aiter_raw()))

        return store

    def _progress(self, record: Orbit) -> tuple[str, dict[str, object]]:
        facts: dict[str, object] = {"frames_done": record.frames_done, "frames": record.frames}
        return f"{record.frames_done} of {record.frames} frames are rendered; ", facts

    def _clear(self, record: Orbit) -> None:
        self._storage.delete_prefix(layout.orbit_frames(record.model, record.id))


def _id_of(etag: str, request: OrbitRequest) -> str:
    # Without a path as before there were any, so that videos which are stored keep their ids.
    exclude = {"camera_path"} if request.camera_path is None else None
    return digest([_VERSION, etag, request.model_dump_json(exclude=exclude)])


def _part_frames(request: OrbitRequest) -> int:
    """Return the number of frames of a part of a video."""
    fewest, most = PART_FRAMES
    return max(fewest, min(most, PART_PIXELS // (request.width * request.height)))

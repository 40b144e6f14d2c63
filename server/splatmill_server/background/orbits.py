"""Orbit videos: rendered in the background, a part at a time, and kept in storage with their model.

An orbit video is a record, and a mark while it has not ended, so that after a restart of the API or the renderer it
continues with the first frame that is not stored. Its id follows from the model and the request, so that the same
request finds the same video.
"""

import hashlib
import json
from datetime import UTC, datetime

import httpx
import structlog
from pydantic import BaseModel, ValidationError
from redis import Redis
from redis.exceptions import RedisError
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, reason, warn
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import (
    DEFAULT_OWNER,
    PROBLEMS,
    JoinOrbit,
    Orbit,
    OrbitFrames,
    OrbitRequest,
    OrbitState,
    Problem,
)
from splatmill_server.access.caller import Caller
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.renderer import no_renderer, post
from splatmill_server.base.root_path import address
from splatmill_server.base.turns import Turns
from splatmill_server.base.unfinished import Unfinished
from splatmill_server.models import Models
from splatmill_server.space.quota import RECORD_BYTES, Quota

log = structlog.get_logger()

MAX_UNFINISHED = 20
"""Orbit videos of one owner that may be unfinished at once."""

MAX_OF_MODEL = 100
"""Orbit videos of one model that are kept."""

MAX_ATTEMPTS = 4
"""Times that the renderer is asked for one part. A renderer that cannot be reached, or is busy, is asked for ever."""

PART_PIXELS = 16_000_000
PART_FRAMES = (8, 48)
"""Pixels of all frames of a part, and its smallest and largest number of frames.

At 640 x 480, a part takes a second of two cores. It is what a restart repeats, and each begins with a frame that refers
to none before it, so that smaller parts make a larger video.
"""

_AT_ONCE = 8
"""Orbit videos that one API process has rendered at once, each of another owner."""

_LOOK_SECONDS = 15.0
"""Seconds between two looks for orbit videos that another process has left."""

_PAUSE_SECONDS = 2.0
"""Seconds before a renderer that did not deliver is asked again."""

_VERSION = "1"
"""Part of each id, to be raised when the same request gives another video than before."""


class _Delayed(Exception):
    """A part was not made or stored. It may be later: `problem` says why, `counts` whether the renderer tried."""

    def __init__(self, problem: Problem, *, counts: bool) -> None:
        super().__init__(problem.detail)
        self.problem = problem
        self.counts = counts


class Orbits:
    """All operations on orbit videos.

    seconds: how long the renderer may take for a part.
    """

    def __init__(
        self,
        storage: Storage,
        connection: Redis,
        models: Models,
        renderer: httpx.AsyncClient | None,
        quota: Quota,
        seconds: float,
    ) -> None:
        self._storage = storage
        self._connection = connection
        self._models = models
        self._renderer = renderer
        self._quota = quota
        self._seconds = seconds
        self._failures: dict[str, int] = {}
        """By the name of a mark, the times in a row that the renderer was asked for the same part and failed."""
        self.unfinished = Unfinished(
            connection,
            storage,
            "orbit",
            layout.unfinished_orbits(),
            self._work,
            line=lambda name: name.partition(".")[0],
            exists=self._exists,
            turns=Turns(_AT_ONCE, 1),
            look_seconds=_LOOK_SECONDS,
        )

    async def create(self, model_id: str, request: OrbitRequest, who: Caller) -> Orbit:
        """Return the orbit video of a request, which is rendered in the background if it is not there.

        who: the caller. Its quota must have room for the record; each part of the video is reserved on its own.

        Raises 404 and 409 problems of the model, a 503 problem without a renderer, a 409 problem for too many orbit
        videos, and a 507 problem where the quota is used up.
        """
        made = await run_in_threadpool(self._accept, model_id, request, who)
        self.unfinished.wake()
        return made

    def _accept(self, model_id: str, request: OrbitRequest, who: Caller) -> Orbit:
        ply = self._models.get_file(model_id, "model.ply")
        if self._renderer is None:
            raise no_renderer()
        orbit_id = _id_of(ply.etag, request)
        orbit = self._read(model_id, orbit_id)
        if orbit is not None and orbit.state is OrbitState.succeeded:
            return orbit
        owner = self._owner(model_id)
        # Until the mark is there: of many requests at once, each counts those before it.
        with exclusive(self._connection, "orbits", _line_of(owner)):
            return self._mark(model_id, orbit_id, request, who, owner)

    def _mark(self, model_id: str, orbit_id: str, request: OrbitRequest, who: Caller, owner: str) -> Orbit:
        """Record and mark an orbit video, unless another request has. Raises the problems of `create`."""
        orbit = self._read(model_id, orbit_id)
        if orbit is not None and orbit.state is OrbitState.succeeded:
            return orbit
        mark = layout.unfinished_orbit(_line_of(owner), model_id, orbit_id)
        if orbit is None or orbit.state is OrbitState.failed:
            self._check_number(model_id, _line_of(owner), new=orbit is None)
            orbit = Orbit(
                id=orbit_id,
                model=model_id,
                request=request,
                state=OrbitState.queued,
                frames=request.frames,
                created_at=datetime.now(UTC),
            )
            with self._quota.room(who, owner, model_id, RECORD_BYTES) as room:
                self._put(orbit)
                room.stored = RECORD_BYTES
        # After the record, without which a mark is removed; also for a record whose mark was never written.
        self._storage.put_new(mark, b"{}")
        return _with_links(orbit)

    def _check_number(self, model_id: str, line: str, *, new: bool) -> None:
        marks = [entry.path.rsplit("/", 1)[-1] for entry in self._storage.entries(layout.unfinished_orbits())]
        if sum(mark.partition(".")[0] == line for mark in marks) >= MAX_UNFINISHED:
            raise ProblemError(
                "too_many_orbits",
                f"{MAX_UNFINISHED} orbit videos of this owner wait already, or are being rendered.",
                advice="Wait until one has ended, or delete one.",
                facts={"limit": MAX_UNFINISHED},
            )
        if new and len(self._storage.children(layout.model_orbits(model_id))) >= MAX_OF_MODEL:
            raise ProblemError(
                "too_many_orbits",
                f"The model {model_id} has {MAX_OF_MODEL} orbit videos.",
                advice=f"Delete those that are no longer needed; GET /v1/models/{model_id}/orbits lists them.",
                facts={"limit": MAX_OF_MODEL},
            )

    def get(self, model_id: str, orbit_id: str) -> Orbit:
        """Return an orbit video. Raises 404 problems, and the problems of the model."""
        self._models.check(model_id)
        orbit = self._read(model_id, orbit_id) if layout.is_id(orbit_id) else None
        if orbit is None:
            raise ProblemError(
                "orbit_not_found",
                f"The model {model_id} has no orbit video {orbit_id[:80]!r}.",
                advice=f"List its orbit videos with GET /v1/models/{model_id}/orbits.",
            )
        return orbit

    def get_video_path(self, model_id: str, orbit_id: str) -> str:
        """Return the path of a video in storage. Raises the problems of `get`, and a 409 problem if it is not whole."""
        orbit = self.get(model_id, orbit_id)
        if orbit.state is not OrbitState.succeeded:
            raise ProblemError(
                "orbit_not_ready",
                f"{orbit.frames_done} of {orbit.frames} frames are rendered; the orbit video is {orbit.state.value}.",
                advice="Wait until it has succeeded."
                if orbit.problem is None
                else "Ask for it again with POST; its problem says why it failed.",
                facts={"state": orbit.state.value, "frames_done": orbit.frames_done, "frames": orbit.frames},
            )
        return layout.orbit_video(model_id, orbit_id)

    def list(self, model_id: str) -> list[Orbit]:
        """Return the orbit videos of a model, newest first. Raises the problems of the model."""
        self._models.check(model_id)
        names = self._storage.children(layout.model_orbits(model_id))
        orbits = [orbit for name in names if (orbit := self._read(model_id, name)) is not None]
        return sorted(orbits, key=lambda orbit: orbit.created_at, reverse=True)

    async def delete(self, model_id: str, orbit_id: str) -> None:
        """Delete an orbit video. One that is not whole is not rendered any further. Raises the problems of `get`."""
        name = await run_in_threadpool(self._forget, model_id, orbit_id)
        self._failures.pop(name, None)
        self.unfinished.cancel(name.__eq__)

    def _forget(self, model_id: str, orbit_id: str) -> str:
        self.get(model_id, orbit_id)
        mark = layout.unfinished_orbit(_line_of(self._owner(model_id)), model_id, orbit_id)
        # The mark first: what a process that works on the video stores after this, it deletes again.
        self._storage.delete(mark)
        self._storage.delete_prefix(layout.orbit(model_id, orbit_id))
        return mark.rsplit("/", 1)[-1]

    async def run(self) -> None:
        """Have unfinished orbit videos rendered until this task is cancelled. They are then taken up again later."""
        if self._renderer is not None:
            await self.unfinished.run()

    def _exists(self, name: str) -> bool:
        """Return whether an orbit video is to be rendered: neither it nor its model was deleted."""
        marked = self._storage.exists(f"{layout.unfinished_orbits()}/{name}")
        return marked and self._storage.exists(layout.job_record(name.split(".")[1]))

    async def _work(self, name: str) -> float | None:
        """Have an orbit video rendered to its end, or return the seconds after which the renderer is asked again."""
        _, model_id, orbit_id = name.split(".")
        failures = self._failures.pop(name, 0)
        while (orbit := await run_in_threadpool(self._read, model_id, orbit_id)) and not orbit.state.final:
            try:
                after = await self._next(name, orbit)
                failures = 0
            except _Delayed as delay:
                failures += delay.counts
                log.info("an orbit video waits", model=model_id, id=orbit_id, reason=str(delay))
                if failures < MAX_ATTEMPTS:
                    self._failures[name] = failures
                    return _PAUSE_SECONDS
                after = _failed(orbit, delay.problem)
            except ProblemError as error:
                after = _failed(orbit, error.problem)
            except (StorageError, RedisError):
                raise  # the video waits until storage and Redis answer
            except Exception as error:
                log.exception("an orbit video failed unexpectedly", model=model_id, id=orbit_id)
                after = _failed(
                    orbit, _orbit_problem("render_failed", f"Unexpected error: {type(error).__name__}.")
                )
            if after is not None:
                await run_in_threadpool(self._write, name, after)
        if orbit is None:
            await run_in_threadpool(self._storage.delete_prefix, layout.orbit(model_id, orbit_id))
        elif orbit.state is OrbitState.succeeded:
            await run_in_threadpool(self._storage.delete_prefix, layout.orbit_frames(model_id, orbit_id))
        await run_in_threadpool(self._storage.delete, f"{layout.unfinished_orbits()}/{name}")
        return None

    async def _next(self, name: str, orbit: Orbit) -> Orbit | None:
        """Have the next part rendered, or the video made of all, and return the record; None if it was deleted."""
        model_id, first = orbit.model, orbit.frames_done
        if first < orbit.frames:
            count = min(_part_frames(orbit.request), orbit.frames - first)
            body = OrbitFrames(orbit=orbit.request, first=first, count=count)
            path = layout.orbit_frames(model_id, orbit.id, first)
            await self._ask(name, rendering.orbit_frames_path(model_id), body, path)
            return orbit.model_copy(update={"state": OrbitState.running, "frames_done": first + count})
        path = layout.orbit_video(model_id, orbit.id)
        whole = JoinOrbit(orbit=orbit.id, frames=orbit.frames)
        await self._ask(name, rendering.orbit_join_path(model_id), whole, path)
        entry = await run_in_threadpool(self._storage.head, path)
        if entry is None:
            return None
        return orbit.model_copy(
            update={"state": OrbitState.succeeded, "bytes": entry.size, "finished_at": datetime.now(UTC)}
        )

    async def _ask(self, name: str, address: str, body: BaseModel, path: str) -> None:
        """Store what the renderer answers at `path`."""
        # The videos of an owner take turns with the views that its people render.
        model_id = name.split(".")[1]
        owner = await run_in_threadpool(self._owner, model_id)
        headers = {rendering.CLIENT_HEADER: rendering.client_of(owner, "orbits")}
        try:
            answer = await post(self._renderer, address, body.model_dump_json(), headers, self._seconds)
        except ProblemError as error:
            refused = isinstance(error.__cause__, httpx.ConnectError | httpx.ConnectTimeout)
            raise _Delayed(error.problem, counts=not refused) from error
        try:
            if answer.status_code != 200:
                raise _refusal(await answer.aread())
            async with self._quota.storing(None, owner, model_id) as room:
                await run_in_threadpool(room.announce, answer.headers.get("content-length"))
                await self._storage.stream_put(path, room.counted(answer.aiter_raw()))
        except httpx.TransportError as error:
            detail = f"The renderer ended before its answer did ({type(error).__name__})."
            raise _Delayed(_orbit_problem("render_failed", detail), counts=True) from error
        except ProblemError as error:
            if (
                error.problem.status == 503
            ):  # storage has not been listed yet, so that no room can be reserved
                raise _Delayed(error.problem, counts=False) from error
            raise
        finally:
            await answer.aclose()

    def _owner(self, model_id: str) -> str:
        return self._models.get_owner(model_id) or DEFAULT_OWNER

    def _read(self, model_id: str, orbit_id: str) -> Orbit | None:
        path = layout.orbit_record(model_id, orbit_id)
        try:
            return _with_links(Orbit.model_validate_json(self._storage.get(path)))
        except FileNotFoundError:
            return None
        except ValueError as error:
            warn(path, reason(error))
            return None

    def _put(self, record: Orbit) -> None:
        fields = record.model_dump(mode="json", exclude_none=True, exclude={"links"}) | {"format": FORMAT}
        self._storage.put(layout.orbit_record(record.model, record.id), json.dumps(fields).encode())

    def _write(self, name: str, record: Orbit) -> None:
        """Store the record, unless the video or its model was deleted."""
        self._put(record)
        marked = self._storage.exists(f"{layout.unfinished_orbits()}/{name}")
        if not (marked and self._storage.exists(layout.job_record(record.model))):
            self._storage.delete_prefix(layout.orbit(record.model, record.id))


def _line_of(owner: str) -> str:
    """Return what the marks of all videos of an owner's models begin with."""
    return hashlib.sha256(owner.encode()).hexdigest()[:16]


def _id_of(etag: str, request: OrbitRequest) -> str:
    # Without a path as before there were any, so that videos which are stored keep their ids.
    parts = [
        _VERSION,
        etag,
        request.model_dump_json(exclude={"camera_path"} if request.camera_path is None else None),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _part_frames(request: OrbitRequest) -> int:
    """Return the number of frames of a part of a video."""
    fewest, most = PART_FRAMES
    return max(fewest, min(most, PART_PIXELS // (request.width * request.height)))


def _refusal(body: bytes) -> Exception:
    """What an answer of the renderer without a video means: that it may be asked again, or a problem of the video."""
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError:
        problem = _orbit_problem("render_failed", "The renderer answered without a problem document.")
    if problem.code not in PROBLEMS:
        problem = _orbit_problem("render_failed", problem.detail)
    if problem.status >= 500 and problem.code != "model_corrupt":
        return _Delayed(problem, counts=problem.status != 503)
    return ProblemError(problem.code, problem.detail, advice=problem.advice, facts=problem.facts)


def _orbit_problem(code: str, detail: str) -> Problem:
    advice = "Ask for the video again. If the problem persists, read the log of the renderer."
    return Problem.of(code, detail, advice=advice)


def _failed(orbit: Orbit, problem: Problem) -> Orbit:
    return orbit.model_copy(
        update={"state": OrbitState.failed, "problem": problem, "finished_at": datetime.now(UTC)}
    )


def _with_links(orbit: Orbit) -> Orbit:
    base = address(f"/v1/models/{orbit.model}/orbits/{orbit.id}")
    return orbit.model_copy(update={"links": {"self": base, "video": f"{base}/video"}})

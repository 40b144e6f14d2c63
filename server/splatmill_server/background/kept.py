"""What the renderer makes of a model in the background and the server keeps with it: orbit videos and meshes.

Each is a record, and a mark while it has not ended, so that it continues after a restart of the API or the renderer.
Its id follows from the model and the request, so that the same request finds the same thing.
"""

import builtins
import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from typing import ClassVar, Generic, TypeVar

import httpx
import structlog
from pydantic import BaseModel, ValidationError
from redis import Redis
from redis.exceptions import RedisError
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, read_record
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import DEFAULT_OWNER, PROBLEMS, Kept, KeptState, Problem
from splatmill_server.access.caller import Caller
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.renderer import no_renderer, post
from splatmill_server.base.root_path import address
from splatmill_server.base.turns import Turns
from splatmill_server.base.unfinished import Unfinished
from splatmill_server.models import Models
from splatmill_server.space.quota import RECORD_BYTES, Arrival, Quota

log = structlog.get_logger()

MAX_ATTEMPTS = 4
"""Times that the renderer is asked for one part. A renderer that cannot be reached, or is busy, is asked for ever."""

_AT_ONCE = 8
"""How many of one kind one API process has made at once, each of another owner."""

_LOOK_SECONDS = 15.0
"""Seconds between two looks for what another process has left."""

_PAUSE_SECONDS = 2.0
"""Seconds before a renderer that did not deliver is asked again."""

Record = TypeVar("Record", bound=Kept)


class Delayed(Exception):
    """Nothing was made or stored. It may be later: `problem` says why, `counts` whether the renderer tried."""

    def __init__(self, problem: Problem, *, counts: bool) -> None:
        super().__init__(problem.detail)
        self.problem = problem
        self.counts = counts


class KeptOfModels(ABC, Generic[Record]):
    """All operations on one kind of what is made in the background.

    kind: the name of its folders and addresses, and that of several in codes of problems.
    code: the name of one in codes of problems.
    noun, nouns: how sentences name one, and several.
    failure: the code of the problem where the renderer does not say why it made none.
    record: the type of its records.
    file: the last part of the address of its file, and the name of that among the links.
    most_unfinished: how many of one owner may be unfinished at once.
    most_of_model: how many of one model are kept.
    seconds: how long the renderer may be silent.
    """

    kind: ClassVar[layout.KeptKind]
    code: ClassVar[str]
    noun: ClassVar[str]
    nouns: ClassVar[str]
    failure: ClassVar[str]
    record: type[Record]
    file: ClassVar[str]
    most_unfinished: ClassVar[int]
    most_of_model: ClassVar[int]

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
            self.code,
            layout.unfinished_kept(self.kind),
            self._work,
            line=lambda name: name.partition(".")[0],
            exists=self._exists,
            turns=Turns(_AT_ONCE, 1),
            look_seconds=_LOOK_SECONDS,
        )

    @abstractmethod
    async def _next(self, name: str, record: Record) -> Record | None:
        """Have the next part made and stored, and return the record; None if it was deleted."""

    async def _begin(
        self, model_id: str, id_of: Callable[[str], str], new: Callable[[str], Record], who: Caller
    ) -> Record:
        """Return the record with the id that `id_of` makes of the model's ETag, and begin it where it is not there.

        new: returns a new record with this id.
        who: the caller. Its quota must have room for the record; what is made is reserved on its own.

        Raises 404 and 409 problems of the model, a 503 problem without a renderer, a 409 problem for too many, and a
        507 problem where the quota is used up.
        """
        made = await run_in_threadpool(self._accept, model_id, id_of, new, who)
        self.unfinished.wake()
        return made

    def _accept(
        self, model_id: str, id_of: Callable[[str], str], new: Callable[[str], Record], who: Caller
    ) -> Record:
        ply = self._models.get_file(model_id, "model.ply")
        if self._renderer is None:
            raise no_renderer()
        kept_id = id_of(ply.etag)
        record = self._read(model_id, kept_id)
        if record is not None and record.state is KeptState.succeeded:
            return record
        owner = self._owner(model_id)
        # Until the mark is there: of many requests at once, each counts those before it.
        with exclusive(self._connection, self.kind, _line_of(owner)):
            return self._mark(model_id, kept_id, new, who, owner)

    def _mark(
        self, model_id: str, kept_id: str, new: Callable[[str], Record], who: Caller, owner: str
    ) -> Record:
        """Record and mark a new one, unless another request has. Raises the problems of `_begin`."""
        record = self._read(model_id, kept_id)
        if record is not None and record.state is KeptState.succeeded:
            return record
        mark = layout.unfinished_mark(self.kind, _line_of(owner), model_id, kept_id)
        if record is None or record.state is KeptState.failed:
            self._check_number(model_id, _line_of(owner), new=record is None)
            record = new(kept_id)
            with self._quota.room(who, owner, model_id, RECORD_BYTES) as room:
                self._put(record)
                room.stored = RECORD_BYTES
        # After the record, without which a mark is removed; also for a record whose mark was never written.
        self._storage.put_new(mark, b"{}")
        return self._with_links(record)

    def _check_number(self, model_id: str, line: str, *, new: bool) -> None:
        folder = layout.unfinished_kept(self.kind)
        marks = [entry.path.rsplit("/", 1)[-1] for entry in self._storage.entries(folder)]
        if sum(mark.partition(".")[0] == line for mark in marks) >= self.most_unfinished:
            raise ProblemError(
                f"too_many_{self.kind}",
                f"{self.most_unfinished} {self.nouns} of this owner wait already, or are being made.",
                advice="Wait until one has ended, or delete one.",
                facts={"limit": self.most_unfinished},
            )
        if new and len(self._storage.children(layout.kept_of(model_id, self.kind))) >= self.most_of_model:
            raise ProblemError(
                f"too_many_{self.kind}",
                f"The model {model_id} has {self.most_of_model} {self.nouns}.",
                advice=f"Delete those that are no longer needed; GET /v1/models/{model_id}/{self.kind} lists them.",
                facts={"limit": self.most_of_model},
            )

    def get(self, model_id: str, kept_id: str) -> Record:
        """Return one. Raises 404 problems, and the problems of the model."""
        self._models.check(model_id)
        record = self._read(model_id, kept_id) if layout.is_id(kept_id) else None
        if record is None:
            raise ProblemError(
                f"{self.code}_not_found",
                f"The model {model_id} has no {self.noun} {kept_id[:80]!r}.",
                advice=f"List its {self.nouns} with GET /v1/models/{model_id}/{self.kind}.",
            )
        return record

    def get_whole(self, model_id: str, kept_id: str) -> Record:
        """Return one whose file is there. Raises the problems of `get`, and a 409 problem if it is not whole."""
        record = self.get(model_id, kept_id)
        if record.state is not KeptState.succeeded:
            text, facts = self._progress(record)
            raise ProblemError(
                f"{self.code}_not_ready",
                f"{text}the {self.noun} is {record.state.value}.".capitalize(),
                advice="Wait until it has succeeded."
                if record.problem is None
                else "Ask for it again with POST; its problem says why it failed.",
                facts={"state": record.state.value, **facts},
            )
        return record

    def list(self, model_id: str) -> builtins.list[Record]:
        """Return those of a model, newest first. Raises the problems of the model."""
        self._models.check(model_id)
        names = self._storage.children(layout.kept_of(model_id, self.kind))
        records = [record for name in names if (record := self._read(model_id, name)) is not None]
        return sorted(records, key=lambda record: record.created_at, reverse=True)

    async def delete(self, model_id: str, kept_id: str) -> None:
        """Delete one. What is not whole is not made any further. Raises the problems of `get`."""
        name = await run_in_threadpool(self._forget, model_id, kept_id)
        self._failures.pop(name, None)
        self.unfinished.cancel(name.__eq__)

    def _forget(self, model_id: str, kept_id: str) -> str:
        self.get(model_id, kept_id)
        mark = layout.unfinished_mark(self.kind, _line_of(self._owner(model_id)), model_id, kept_id)
        # The mark first: what a process that works on it stores after this, it deletes again.
        self._storage.delete(mark)
        self._storage.delete_prefix(layout.kept(model_id, self.kind, kept_id))
        return mark.rsplit("/", 1)[-1]

    async def run(self) -> None:
        """Have what has not ended made until this task is cancelled. It is then taken up again later."""
        if self._renderer is not None:
            await self.unfinished.run()

    def _exists(self, name: str) -> bool:
        """Return whether one is to be made: neither it nor its model was deleted."""
        marked = self._storage.exists(f"{layout.unfinished_kept(self.kind)}/{name}")
        return marked and self._storage.exists(layout.job_record(name.split(".")[1]))

    async def _work(self, name: str) -> float | None:
        """Have one made to its end, or return the seconds after which the renderer is asked again."""
        _, model_id, kept_id = name.split(".")
        failures = self._failures.pop(name, 0)
        while (record := await run_in_threadpool(self._read, model_id, kept_id)) and not record.state.final:
            try:
                after = await self._next(name, record)
                failures = 0
            except Delayed as delay:
                failures += delay.counts
                log.info(
                    "the renderer is asked again",
                    kind=self.code,
                    model=model_id,
                    id=kept_id,
                    reason=str(delay),
                )
                if failures < MAX_ATTEMPTS:
                    self._failures[name] = failures
                    return _PAUSE_SECONDS
                after = _failed(record, delay.problem)
            except ProblemError as error:
                after = _failed(record, error.problem)
            except (StorageError, RedisError):
                raise  # it waits until storage and Redis answer
            except Exception as error:
                log.exception("an unexpected failure", kind=self.code, model=model_id, id=kept_id)
                after = _failed(record, self._failed_because(f"Unexpected error: {type(error).__name__}."))
            if after is not None:
                await run_in_threadpool(self._write, name, after)
        if record is None:
            await run_in_threadpool(self._storage.delete_prefix, layout.kept(model_id, self.kind, kept_id))
        elif record.state is KeptState.succeeded:
            await run_in_threadpool(self._clear, record)
        await run_in_threadpool(self._storage.delete, f"{layout.unfinished_kept(self.kind)}/{name}")
        return None

    async def _ask(
        self,
        name: str,
        path: str,
        body: BaseModel,
        store: Callable[[httpx.Response, Arrival], Awaitable[None]],
    ) -> None:
        """Ask the renderer, and let `store` store what it answers, in room that is reserved for the owner."""
        # What is made for an owner takes turns with the views that its people render.
        model_id = name.split(".")[1]
        owner = await run_in_threadpool(self._owner, model_id)
        headers = {rendering.CLIENT_HEADER: rendering.client_of(owner, self.kind)}
        try:
            answer = await post(self._renderer, path, body.model_dump_json(), headers, self._seconds)
        except ProblemError as error:
            refused = isinstance(error.__cause__, httpx.ConnectError | httpx.ConnectTimeout)
            raise Delayed(error.problem, counts=not refused) from error
        try:
            if answer.status_code != 200:
                raise self._refusal(await answer.aread())
            async with self._quota.storing(None, owner, model_id) as room:
                await store(answer, room)
        except httpx.TransportError as error:
            detail = f"The renderer ended before its answer did ({type(error).__name__})."
            raise Delayed(self._failed_because(detail), counts=True) from error
        except ProblemError as error:
            if (
                error.problem.status == 503
            ):  # storage has not been listed yet, so that no room can be reserved
                raise Delayed(error.problem, counts=False) from error
            raise
        finally:
            await answer.aclose()

    async def _whole(self, record: Record, path: str) -> Record | None:
        """Return the record of one whose file is stored at `path`; None if that was deleted."""
        entry = await run_in_threadpool(self._storage.head, path)
        if entry is None:
            return None
        return record.model_copy(
            update={"state": KeptState.succeeded, "bytes": entry.size, "finished_at": datetime.now(UTC)}
        )

    def _progress(self, record: Record) -> tuple[str, dict[str, object]]:
        """Return the beginning of a sentence that says how far one is, and the same as facts of a problem."""
        return "", {}

    def _clear(self, record: Record) -> None:
        """Delete what one needed until it was whole."""

    def _refusal(self, body: bytes) -> Exception:
        """What a refusal of the renderer means: that it may be asked again, or a problem of what was asked for."""
        try:
            problem = Problem.model_validate_json(body)
        except ValidationError:
            problem = self._failed_because("The renderer answered without a problem document.")
        if problem.code not in PROBLEMS:
            problem = self._failed_because(problem.detail)
        if problem.status >= 500 and problem.code not in ("model_corrupt", "out_of_memory"):
            return Delayed(problem, counts=problem.status != 503)
        return ProblemError(problem.code, problem.detail, advice=problem.advice, facts=problem.facts)

    def _failed_because(self, detail: str) -> Problem:
        advice = f"Ask for the {self.noun} again. If the problem persists, read the log of the renderer."
        return Problem.of(self.failure, detail, advice=advice)

    def _owner(self, model_id: str) -> str:
        return self._models.get_owner(model_id) or DEFAULT_OWNER

    def _read(self, model_id: str, kept_id: str) -> Record | None:
        record = read_record(self._storage, layout.kept_record(model_id, self.kind, kept_id), self.record)
        return None if record is None else self._with_links(record)

    def _put(self, record: Record) -> None:
        fields = record.model_dump(mode="json", exclude_none=True, exclude={"links"}) | {"format": FORMAT}
        path = layout.kept_record(record.model, self.kind, record.id)
        self._storage.put(path, json.dumps(fields).encode())

    def _write(self, name: str, record: Record) -> None:
        """Store the record, unless it or its model was deleted."""
        self._put(record)
        if not self._exists(name):
            self._storage.delete_prefix(layout.kept(record.model, self.kind, record.id))

    def _with_links(self, record: Record) -> Record:
        base = address(f"/v1/models/{record.model}/{self.kind}/{record.id}")
        return record.model_copy(update={"links": {"self": base, self.file: f"{base}/{self.file}"}})


def digest(parts: list[str]) -> str:
    """Return the id that follows from texts."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _line_of(owner: str) -> str:
    """Return what the marks of all that is made of an owner's models begin with."""
    return digest([owner])


def _failed(record: Record, problem: Problem) -> Record:
    return record.model_copy(
        update={"state": KeptState.failed, "problem": problem, "finished_at": datetime.now(UTC)}
    )

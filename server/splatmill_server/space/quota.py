"""Quotas: how many bytes an owner may have in storage.

Nothing is stored for an owner with a limit before its bytes are reserved in the ledger, and of several requests at once
only those are admitted that fit together. An upload is refused before it begins if its announced size does not fit, and
while it arrives otherwise. A job reserves JOB_ROOM, and its worker what it stores beyond that.
"""

import json
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import reservations
from splatmill.backplane.reservations import NoRoom
from splatmill.schema import DEFAULT_OWNER, Job, Scope, StoredKind, format_bytes
from splatmill.schema.headers import read_integer
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.space.holdings import folder
from splatmill_server.space.usage import Usage

log = structlog.get_logger()

STEP = 8 << 20
"""Bytes by which the entry of an upload of unknown size grows."""

_OLDEST = 60.0
"""Seconds: with older figures, storage is scanned before an upload or a job with a limit."""

_TOUCH_SECONDS = 60.0

JOB_ROOM = 16 << 20
"""Bytes that are reserved for a new job, or what is left if that is less: log, curve, and a small model."""

CAPTURE_BYTES = 160
"""Bytes that an empty capture takes beside its record, at most: the beginning of its manifest."""

RECORD_BYTES = 4096
"""Bytes reserved for a record while it is written: of a capture, an import, an upload in parts or an orbit video."""


def bytes_beside(name: str) -> int:
    """Return the most bytes that a file of a capture takes beside its own: its digest, and its row in the manifest."""
    return 160 + len(json.dumps(name))


class Quota:
    """Checks uploads and new jobs against the limit of their owner, and enters uploads into the ledger.

    default: the limit of owners whose key has none; None is no limit.

    Methods raise redis.RedisError, and 503 problems, only where there is a limit. Uploads without one do not depend on
    Redis; the next scan of storage counts them.
    """

    def __init__(self, usage: Usage, captures: Captures, default: int | None) -> None:
        self.usage = usage
        self.captures = captures
        self.default = default

    def limit(self, who: Caller, owner: str) -> int | None:
        """Return the limit of what `who` adds to the records of `owner`."""
        own = who.limits.bytes_stored if who.owner == owner else None
        return own if own is not None else self.default

    def known_limit(self, owner: str) -> int | None:
        """Return the limit of an owner as of the last request that added something to its records."""
        noted = self.usage.ledger.noted_limit(owner)
        return noted if noted is not None else self.default

    def check_new(self, who: Caller, capture_id: str | None = None, size: int = 0) -> None:
        """Raise a 507 problem if `size` more bytes do not fit into the quota, or the quota is used up.

        capture_id: the capture whose owner gets the bytes; without one, they are the caller's.
        """
        owner = self.captures.get(capture_id).owner if capture_id is not None else who.owner
        limit = self.limit(who, owner)
        if limit is None:
            return
        self._refresh()
        if who.owner == owner:
            self.note(who)
        used = self.usage.ledger.bytes_of(owner)
        if used + max(size, 1) > limit:
            raise _exceeded(owner, used, limit, size or None)

    def _refresh(self) -> None:
        """Scan storage if the figures are old. Raises a 503 problem if there are none yet."""
        self.usage.refresh(_OLDEST)
        if self.usage.ledger.last_scan() is None:
            raise ProblemError(
                "storage_unavailable",
                "It is not known yet how many bytes are stored: storage is being listed for the first time.",
                advice="Try again in a minute.",
            )

    def note(self, who: Caller) -> None:
        """Note the limit of a caller, for what is stored for its records without it.

        That of a key which only reads is not noted: it need not have one, and would lift that of the owner's jobs.
        """
        if who.has(Scope.train):
            self.usage.ledger.note_limits(who.owner, who.limits.bytes_stored, self.default)

    @contextmanager
    def room(self, who: Caller | None, owner: str, record_id: str, size: int = 1) -> Iterator["Arrival"]:
        """Reserve bytes for a record while the context is open; what it has left is then entered by `stored`.

        who: the caller; None where there is none, and the limit last noted for the owner counts.

        After an error, nothing counts as stored. Raises a 507 problem where the quota does not suffice.
        """
        arrival = Arrival(self.usage, owner, record_id, self._begin(who, owner))
        try:
            arrival.claim(size)
            yield arrival
        except BaseException:
            arrival.stored = arrival.stored or 0
            raise
        finally:
            arrival.end()

    @asynccontextmanager
    async def storing(
        self, who: Caller | None, owner: str, record_id: str, size: int = 1
    ) -> AsyncIterator["Arrival"]:
        """Do as `room`, from a coroutine."""
        room = self.room(who, owner, record_id, size)
        arrival = await run_in_threadpool(room.__enter__)
        try:
            yield arrival
        except BaseException as error:
            await run_in_threadpool(room.__exit__, type(error), error, error.__traceback__)
            raise
        await run_in_threadpool(room.__exit__, None, None, None)

    @contextmanager
    def job(self, who: Caller, owner: str) -> Iterator[Callable[[str], None]]:
        """Reserve room for a job that is created or restarted in the context; what is yielded is called with its id.

        Raises a 507 problem if the quota is used up.
        """
        limit = self._begin(who, owner)
        if limit is None:
            yield lambda job_id: None
            return
        ledger, field, size = self.usage.ledger, _token(), JOB_ROOM
        while True:
            try:
                ledger.reserve(owner, field, size, "", limit)
                break
            except NoRoom as refused:
                left = refused.limit - refused.used
                if left < 1:
                    raise _exceeded(owner, refused.used, limit, None) from None
                size = min(left, size - 1)

        def keep(job_id: str) -> None:
            # What the first reservation holds is taken over, so that this one always fits.
            ledger.reserve(owner, reservations.job(job_id), size, job_id, None, beyond=True)

        try:
            yield keep
        finally:
            ledger.settle(owner, field, "", 0)

    def job_ended(self, job: Job, generation: int) -> None:
        """Enter what a job that has ended has left in storage, in place of what was reserved for it."""
        owner, ledger = job.owner or DEFAULT_OWNER, self.usage.ledger
        if ledger.is_reserved(owner, reservations.job(job.id)):
            entries = (
                entry
                for kind in (StoredKind.job, StoredKind.model)
                for entry in self.usage.storage.walk(folder(kind, job.id))
            )
            ledger.settle(owner, reservations.job(job.id), job.id, sum(entry.size for entry in entries))

    @asynccontextmanager
    async def upload(
        self,
        who: Caller | None,
        capture_id: str,
        size: int | None,
        *,
        file: str | None = None,
        beside: int = 0,
        keeps_parts: bool = False,
        is_stored: Callable[[], bool] | None = None,
    ) -> AsyncIterator["Arrival"]:
        """Count an upload while the context is open.

        who: who sends it; None for an upload that nobody waits for, which has the limit last noted for the owner.
        size: announced bytes, or None.
        file: how errors name the file.
        beside: bytes that are stored beside a new file.
        keeps_parts: whether what has arrived stays in storage if the upload breaks off.
        is_stored: returns whether the file is stored already, so that sending it again takes no room.

        Raises a 404 problem without a capture, and a 507 problem where the quota does not suffice.
        """
        try:
            owner = (await run_in_threadpool(self.captures.get_recent, capture_id)).owner
        except ProblemError as error:
            raise (error.about_file(file) if file is not None else error) from error
        limit = await run_in_threadpool(self._begin, who, owner)
        arrival = Arrival(self.usage, owner, capture_id, limit, is_stored)
        arrival.file = file
        arrival.beside = beside
        try:
            await run_in_threadpool(arrival.claim, size or 0)
            yield arrival
        except BaseException:
            arrival.stored = arrival.received if keeps_parts else 0
            raise
        finally:
            await run_in_threadpool(arrival.end)

    def _begin(self, who: Caller | None, owner: str) -> int | None:
        """Return the limit of an owner, with figures to compare it to."""
        try:
            limit = self.limit(who, owner) if who is not None else self.known_limit(owner)
            if who is not None and who.owner == owner:
                self.note(who)
            if limit is not None:
                self._refresh()
        except redis.RedisError:
            if who is None or self.limit(who, owner) is not None:
                raise
            return None
        return limit


class Arrival:
    """An upload that arrives, or something else that is about to be stored.

    record_id: of the capture, job or model that it goes to.
    received: bytes so far.
    stored: bytes that it leaves in storage; 0 where the file was there already. None counts what was received.
    beside: bytes that are stored with it, unless it leaves nothing.
    file: how errors name the file.
    """

    def __init__(
        self,
        usage: Usage,
        owner: str,
        record_id: str,
        limit: int | None,
        is_stored: Callable[[], bool] | None = None,
    ) -> None:
        self.received = 0
        self.stored: int | None = None
        self.beside = 0
        self.file: str | None = None
        self._usage = usage
        self._owner = owner
        self.record_id = record_id
        self._limit = limit
        self._is_stored = is_stored
        self._field = _token()
        self._claimed = 0
        self._touched = time.monotonic()
        self._counted = True

    async def counted(self, chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Pass the bytes on, and raise a 507 problem where they exceed the quota."""
        async for chunk in chunks:
            self.received += len(chunk)
            if self.received > self._claimed or time.monotonic() - self._touched > _TOUCH_SECONDS:
                await run_in_threadpool(self._grow)
            yield chunk

    def announce(self, length: str | None) -> None:
        """Reserve what a Content-Length says is still to arrive. Raises a 507 problem if it does not fit."""
        if (size := read_integer(length)) is not None:
            self.claim(max(self._claimed, self.received + size))

    def take(self, size: int) -> None:
        """Count bytes that are about to be stored at once. Raises a 507 problem where they exceed the quota."""
        self.received += size
        if self.received > self._claimed:
            self.claim(self.received)

    def _grow(self) -> None:
        bytes_needed = max(self._claimed, self.received)
        if self.received > self._claimed:
            bytes_needed = -(-self.received // STEP) * STEP
        try:
            self.claim(bytes_needed)
        except ProblemError:
            if bytes_needed == self.received:
                raise
            self.claim(max(self.received, self._claimed))

    def claim(self, size: int) -> None:
        """Reserve `size` bytes. Raises a 507 problem if they do not fit."""
        if not self._counted:
            return
        ledger = self._usage.ledger
        self._touched = time.monotonic()
        try:
            ledger.reserve(self._owner, self._field, size + self.beside, self.record_id, self._limit)
        except redis.RedisError as error:
            if self._limit is not None:
                raise
            log.warning("an upload is not counted before the next scan of storage", error=str(error))
            self._counted = False
            return
        except NoRoom as refused:
            if self._is_stored is not None and self._is_stored():
                self._counted = False
                ledger.settle(self._owner, self._field, self.record_id, 0)
                return
            problem = _exceeded(self._owner, refused.used, refused.limit, size)
            raise (problem.about_file(self.file) if self.file is not None else problem) from None
        self._claimed = size

    def end(self) -> None:
        """Enter what is left in storage."""
        if self._counted:
            stored = self.received if self.stored is None else self.stored
            stored += self.beside if stored else 0
            try:
                self._usage.ledger.settle(self._owner, self._field, self.record_id, stored)
            except redis.RedisError as error:
                log.warning("an upload is not counted before the next scan of storage", error=str(error))


def _token() -> str:
    return f"{reservations.ARRIVING}/{secrets.token_hex(8)}"


def _exceeded(owner: str, used: int, limit: int, size: int | None) -> ProblemError:
    needs = "" if size is None else f", and this needs {format_bytes(size)}"
    return ProblemError(
        "quota_exceeded",
        f"The owner {owner} has {format_bytes(used)} of {format_bytes(limit)} in storage{needs}.",
        advice="Delete captures or jobs that are no longer needed; `splatmill storage` lists the largest.",
        facts={"used": used, "limit": limit} | ({} if size is None else {"size": size}),
    )

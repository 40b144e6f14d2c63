"""Quotas: how many bytes an owner may have in storage.

An upload is refused before it begins if its announced size does not fit, and while it arrives otherwise. What jobs
leave counts, but ends no job: a new job is refused once the quota is used up.
"""

import secrets
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.schema import format_bytes
from splatmill_server.access.caller import Caller
from splatmill_server.captures.records import Captures
from splatmill_server.problems import ProblemError
from splatmill_server.space.ledger import Upload
from splatmill_server.space.usage import Usage

log = structlog.get_logger()

STEP = 8 << 20
"""Bytes by which the entry of an upload of unknown size grows."""

_OLDEST = 60.0
"""Seconds: with older figures, storage is scanned before an upload or a job with a limit."""

_TOUCH_SECONDS = 60.0


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
        owner = self.captures.record(capture_id).owner if capture_id is not None else who.owner
        limit = self.limit(who, owner)
        if limit is None:
            return
        self._refresh()
        self._note(who, owner)
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

    def _note(self, who: Caller, owner: str) -> None:
        if who.owner == owner:
            self.usage.ledger.note_limit(owner, who.limits.bytes_stored)

    @asynccontextmanager
    async def upload(
        self,
        who: Caller | None,
        capture_id: str,
        size: int | None,
        *,
        file: str | None = None,
        keeps_parts: bool = False,
        is_stored: Callable[[], bool] | None = None,
    ) -> AsyncIterator["Arrival"]:
        """Count an upload while the context is open.

        who: who sends it; None for an upload that nobody waits for, which has the limit last noted for the owner.
        size: announced bytes, or None.
        file: how errors name the file.
        keeps_parts: whether what has arrived stays in storage if the upload breaks off.
        is_stored: returns whether the file is stored already, so that sending it again takes no room.

        Raises a 404 problem without a capture, and a 507 problem where the quota does not suffice.
        """
        try:
            owner = (await run_in_threadpool(self.captures.recent, capture_id)).owner
        except ProblemError as error:
            raise (error.about_file(file) if file is not None else error) from error
        limit = await run_in_threadpool(self._begin, who, owner)
        arrival = Arrival(self.usage, owner, capture_id, limit, is_stored)
        arrival.file = file
        try:
            await run_in_threadpool(arrival.claim, size or 0)
            yield arrival
        except BaseException:
            arrival.stored = arrival.received if keeps_parts else 0
            raise
        finally:
            await run_in_threadpool(arrival.end)

    def _begin(self, who: Caller | None, owner: str) -> int | None:
        try:
            limit = self.limit(who, owner) if who is not None else self.known_limit(owner)
            if who is not None:
                self._note(who, owner)
            if limit is not None:
                self._refresh()
        except redis.RedisError:
            if who is None or self.limit(who, owner) is not None:
                raise
            return None
        return limit


class Arrival:
    """An upload that arrives.

    received: bytes so far.
    stored: bytes that it leaves in storage; 0 where the file was there already.
    file: how errors name the file.
    """

    def __init__(
        self,
        usage: Usage,
        owner: str,
        capture_id: str,
        limit: int | None,
        is_stored: Callable[[], bool] | None,
    ) -> None:
        self.received = 0
        self.stored: int | None = None
        self.file: str | None = None
        self._usage = usage
        self._owner = owner
        self._capture = capture_id
        self._limit = limit
        self._is_stored = is_stored
        self._token = secrets.token_hex(8)
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

    def _grow(self) -> None:
        wanted = max(self._claimed, self.received)
        if self.received > self._claimed:
            wanted = -(-self.received // STEP) * STEP
        try:
            self.claim(wanted)
        except ProblemError:
            if wanted == self.received:
                raise
            self.claim(max(self.received, self._claimed))

    def claim(self, size: int) -> None:
        """Enter the upload with `size` bytes. Raises a 507 problem if they do not fit."""
        if not self._counted:
            return
        ledger = self._usage.ledger
        self._touched = time.monotonic()
        try:
            entry = Upload(bytes=size, capture=self._capture, touched=ledger.clock())
            total = ledger.put_upload(self._owner, self._token, entry)
        except redis.RedisError as error:
            if self._limit is not None:
                raise
            log.warning("an upload is not counted before the next scan of storage", error=str(error))
            self._counted = False
            return
        if self._limit is not None and total > self._limit:
            if self._is_stored is not None and self._is_stored():
                self._counted = False
                self._drop()
                return
            refusal = _exceeded(self._owner, total - size, self._limit, size)
            raise refusal.about_file(self.file) if self.file is not None else refusal
        self._claimed = size

    def end(self) -> None:
        """Enter what the upload leaves in storage."""
        if self._counted:
            stored = self.received if self.stored is None else self.stored
            try:
                self._usage.ledger.end_upload(self._owner, self._token, self._capture, stored)
            except redis.RedisError as error:
                log.warning("an upload is not counted before the next scan of storage", error=str(error))

    def _drop(self) -> None:
        self._usage.ledger.end_upload(self._owner, self._token, self._capture, 0)


def _exceeded(owner: str, used: int, limit: int, size: int | None) -> ProblemError:
    needs = "" if size is None else f", and this upload needs {format_bytes(size)}"
    return ProblemError(
        "quota_exceeded",
        f"The owner {owner} has {format_bytes(used)} of {format_bytes(limit)} in storage{needs}.",
        advice="Delete captures or jobs that are no longer needed; `splatmill storage` lists the largest.",
        facts={"used": used, "limit": limit} | ({} if size is None else {"size": size}),
    )

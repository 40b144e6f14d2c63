"""Pages of lists of captures, jobs and models, read from their indexes in Redis (`splatmill.backplane.lists`).

A page takes a few round trips however many records there are. Where Redis has come back empty, the lists are made anew
from storage, by one process; meanwhile those who ask for a list wait, and after LONGEST_WAIT are told to come again.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import redis
import structlog
from redis.exceptions import LockError
from redis.lock import Lock

from splatmill.backplane import expiry, keys, lists
from splatmill.backplane.lists import NotListed
from splatmill.schema import BinKind, StoredKind
from splatmill_server.base.paging import read_cursor, write_cursor
from splatmill_server.base.problems import ProblemError

log = structlog.get_logger()

T = TypeVar("T")

SCANNED = 2000
"""Largest number of records that are looked at for one page of a list."""

BATCH = 200
"""Number of records that are looked at together at first for a list that does not hold all of them; then twice as many
each time."""

LONGEST_WAIT = 10.0
"""Seconds that a request waits for lists that are being made."""

_TOGETHER = 1000
"""Number of records that are asked for in one round trip."""

_AT_A_TIME = 16
"""Number of records that are read from storage together."""

_LOCK_SECONDS = 30.0
"""Seconds after which the lock of a process that died is free again. The process that makes the lists renews it."""


@dataclass(frozen=True)
class Ended:
    """What a list of models shows of a job that has succeeded.

    moment: the time of its end in milliseconds.
    """

    moment: int
    owner: str
    name: str | None
    tags: Sequence[str] = ()
    favourite: bool = False


class Lists:
    """The lists of one service."""

    def __init__(self, connection: redis.Redis) -> None:
        self.connection = connection
        self.makers: list[Callable[[dict[str, Ended]], int]] = []
        """Each makes the lists of one kind from storage, and returns the number of records. The first, that of jobs,
        adds those that have succeeded to what it is given, so that the records of their models need not be read."""

    def page(
        self,
        names: Sequence[str],
        cursor: str | None,
        limit: int,
        read: Callable[[Sequence[str]], Mapping[str, T]],
        *,
        narrowed: bool,
        likely: Callable[[Sequence[str]], list[str]] | None = None,
    ) -> tuple[list[T], str | None]:
        """Return the records of a page, newest first, and the cursor of the next one.

        names: the lists whose union is paged through.
        read: returns those of the records with these ids that belong to the list, by id.
        narrowed: whether `read` leaves out more than a few.
        likely: leaves out many of those that do not belong to the list, and none that does, for less than `read`, which
            then gets as many as the page still needs.

        At most SCANNED records are looked at; a page then holds fewer than `limit`, and has a cursor all the same.
        Raises problems for a cursor that is not valid (422), and while the lists are being made (503).
        """
        records: list[tuple[int, str, T]] = []
        after = read_cursor(cursor) if cursor is not None else None
        scanned, ended = 0, False
        size = max(limit + 1, BATCH) if narrowed else limit + 1
        while len(records) <= limit and scanned < SCANNED and not ended:
            batch = self.newest(names, after, size)
            ended = len(batch) < size
            scanned += len(batch)
            size = min(max(2 * size, BATCH), SCANNED - scanned)
            after = batch[-1] if batch else after
            moments = {record_id: moment for moment, record_id in batch}
            left = likely(list(moments)) if likely is not None else list(moments)
            while left and len(records) <= limit:
                together = limit + 1 - len(records) if likely is not None else len(left)
                admitted = read(left[:together])
                records += [
                    (moments[name], name, admitted[name]) for name in left[:together] if name in admitted
                ]
                left = left[together:]
        following = None
        if len(records) > limit:
            following = write_cursor(*records[limit - 1][:2])
        elif not ended and after is not None:
            following = write_cursor(*after)
        return [record for _, _, record in records[:limit]], following

    def newest(
        self, names: Sequence[str], after: tuple[int, str] | None, count: int
    ) -> list[tuple[int, str]]:
        """Return up to `count` pairs (time in milliseconds, id) of the union of lists, newest first.

        after: the pair before the first one, or None.

        Raises a 503 problem while the lists are being made.
        """
        try:
            return lists.newest(self.connection, names, after, count)
        except NotListed:
            self.ensure(LONGEST_WAIT)
            return lists.newest(self.connection, names, after, count)

    def ensure(self, wait: float) -> None:
        """Make the lists from storage if they do not hold all records, or wait for another process that does.

        Raises a 503 problem if that takes longer than `wait` seconds, StorageError, and redis.RedisError.
        """
        end = time.monotonic() + wait
        while self.connection.get(keys.LISTED) != lists.VERSION:
            lock = Lock(self.connection, keys.LISTING, timeout=_LOCK_SECONDS, thread_local=False)
            if lock.acquire(blocking=False):
                self._make(lock)
                continue
            expiry.shorten(self.connection, keys.LISTING, _LOCK_SECONDS)
            if time.monotonic() >= end:
                raise ProblemError(
                    "lists_not_ready",
                    "The lists of captures, jobs and models are being made from storage, because Redis has lost them.",
                    advice="Try again in a minute. What is known by its id can be read and changed meanwhile.",
                    headers={"Retry-After": "10"},
                )
            time.sleep(0.05)

    def _make(self, lock: Lock) -> None:
        began, done = time.monotonic(), threading.Event()
        renewal = threading.Thread(target=_renew, args=(lock, done), name="lists", daemon=True)
        renewal.start()
        try:
            succeeded: dict[str, Ended] = {}
            counts = [make(succeeded) for make in self.makers]
            self.connection.set(keys.LISTED, lists.VERSION)
        finally:
            done.set()
            renewal.join()
            with suppress(LockError, redis.RedisError):
                lock.release()
        log.info("lists made from storage", records=sum(counts), seconds=round(time.monotonic() - began, 1))

    def deleted(self, kind: StoredKind, record_ids: Sequence[str]) -> list[str]:
        """Return those of the records whose deletion has begun lately, and may have ended."""
        if not record_ids:
            return []
        names = [keys.deleting(f"{kind.value}/{record_id}") for record_id in record_ids]
        marks = cast(list[bytes | None], self.connection.mget(names))
        return [record_id for record_id, mark in zip(record_ids, marks, strict=True) if mark is not None]

    def missing(self, kind: lists.Kind, record_ids: Sequence[str]) -> list[str]:
        """Return those of the records that are not listed."""
        unlisted = []
        for start in range(0, len(record_ids), _TOGETHER):
            batch = record_ids[start : start + _TOGETHER]
            scores = self.connection.zmscore(lists.name(kind), list(batch))
            unlisted += [name for name, score in zip(batch, scores, strict=True) if score is None]
        return unlisted

    def records(
        self, kind: lists.Kind, record_ids: Sequence[str], without_bin: BinKind | None = None
    ) -> dict[str, bytes | None]:
        """Return what is kept of these records for lists, by id.

        without_bin: as what these records may be in the bin; those that are there are left out.
        """
        if not record_ids:
            return {}
        with self.connection.pipeline(transaction=False) as pipe:
            pipe.hmget(keys.records(kind), list(record_ids))
            pipe.hmget(keys.BIN, [keys.in_bin(without_bin or kind, record_id) for record_id in record_ids])
            kept, binned = pipe.execute()
        return {
            record_id: record
            for record_id, record, mark in zip(record_ids, kept, binned, strict=True)
            if without_bin is None or mark is None
        }

    def keep(self, kind: lists.Kind, records: Mapping[str, bytes]) -> None:
        """Keep what lists show of these records."""
        if records:
            self.connection.hset(keys.records(kind), mapping=cast(Any, records))

    def forget(self, kind: lists.Kind, record_id: str) -> None:
        """Forget what lists show of a record that has changed; it is read when it is next asked for."""
        self.connection.hdel(keys.records(kind), record_id)


def each(read: Callable[[str], T], record_ids: Sequence[str]) -> list[T]:
    """Return what `read` returns for each record, several at a time, because storage may be far away."""
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        return list(pool.map(read, record_ids))


def _renew(lock: Lock, done: threading.Event) -> None:
    while not done.wait(_LOCK_SECONDS / 3):
        with suppress(
            LockError, redis.RedisError
        ):  # lost to another process: to make them twice is only wasteful
            lock.reacquire()

"""Who has how much in storage, and which records are the largest."""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import chain

import redis
import structlog
from redis.exceptions import LockError
from redis.lock import Lock

from splatmill.backplane import expiry, keys
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import OwnerUse, StoredBytes, StoredKind, StoredRecord
from splatmill_server.space.holdings import Holding, folder, scan
from splatmill_server.space.job_uses import JobUse, all_jobs
from splatmill_server.space.ledger import NOBODY, Account, Ledger
from splatmill_server.space.snapshot import Snapshot

log = structlog.get_logger()

SCAN_SHARE = 0.05
"""Largest share of the time that scans of storage take, however often somebody asks for new figures."""

_LOCK_SECONDS = 30.0
"""Seconds after which the lock of a scan whose process died is free again. A scan renews it."""

_FIRST_SCAN_SECONDS = 60
"""Seconds to wait for another process that makes the first scan."""


class Usage:
    """Keeps the ledger in step with storage, and reports from it."""

    def __init__(self, storage: Storage, ledger: Ledger) -> None:
        self.storage = storage
        self.ledger = ledger

    @property
    def connection(self) -> redis.Redis:
        """The connection to Redis."""
        return self.ledger.connection

    def refresh(self, oldest: float) -> None:
        """Scan storage if the last scan is older than `oldest` seconds, unless another process does so already.

        Scans take at most SCAN_SHARE of the time, so that a storage that is slow to list is scanned less often.
        Returns without figures only if the first scan of another process takes very long.
        """
        if not self._is_due(oldest):
            return
        first = self.ledger.last_scan() is None
        lock = Lock(self.connection, keys.SCAN_LOCK, timeout=_LOCK_SECONDS, thread_local=False, sleep=0.05)
        if lock.acquire(blocking=first, blocking_timeout=_FIRST_SCAN_SECONDS if first else None):
            try:
                if self._is_due(oldest):
                    self.scan(lock)
            finally:
                _release(lock)
        else:
            expiry.shorten(self.connection, keys.SCAN_LOCK, _LOCK_SECONDS)

    def _is_due(self, oldest: float) -> bool:
        last = self.ledger.last_scan()
        if last is None:
            return True
        age = self.ledger.clock() - last.ended
        return not age < max(oldest, (last.ended - last.began) / SCAN_SHARE)

    def scan(self, lock: Lock | None = None) -> None:
        """List storage, and replace the figures in the ledger. `lock` is renewed meanwhile."""
        began = self.ledger.clock()
        jobs = all_jobs(self.connection)
        known = {held.key: held for job in jobs.values() for held in _told_by(job)}
        known |= {held.key: held for owner in self.ledger.owners() for held in self.account(owner).holdings}
        first = self.ledger.begin_listing()
        listed = _renewing(lock, self.storage.walk(""))
        holdings = scan(self.storage, listed, known, {job.id: job.owner for job in jobs.values()})
        second = self.ledger.begin_listing()
        # What was written to meanwhile is listed once more: the listing may have missed a part of it, or all.
        busy = self.ledger.stored_since(first)
        folders = [folder(kind, record_id) for record_id in sorted(busy) for kind in StoredKind]
        again = _renewing(lock, chain.from_iterable(map(self.storage.walk, folders)))
        holdings = [held for held in holdings if held.id not in busy]
        holdings += scan(self.storage, again, known, {job.id: job.owner for job in jobs.values()})
        self.ledger.publish(began, second, holdings, {job.id: job.unfinished for job in jobs.values()})
        log.debug("storage scanned", folders=len(holdings), bytes=sum(held.size for held in holdings))

    def account(self, owner: str) -> Account:
        """Return what an owner has in storage."""
        return self.ledger.account(owner)

    def owner_use(self, owner: str, limit: int | None) -> OwnerUse:
        """Return the bytes of an owner by kind. NOBODY stands for what belongs to nobody."""
        account = self.account(owner)
        by_kind = _by_kind(account)
        return OwnerUse(
            owner=None if owner == NOBODY else owner,
            bytes=by_kind.total,
            limit=limit,
            by_kind=by_kind,
            captures=_count(account, StoredKind.capture),
            models=_count(account, StoredKind.model),
        )

    def snapshot(self) -> Snapshot:
        """Return all records in storage as of the last scan, and how jobs use them now."""
        held = [holding for owner in self.ledger.owners() for holding in self.account(owner).holdings]
        return Snapshot.of(held, all_jobs(self.connection))

    def scanned_at(self) -> datetime:
        """Return when the last scan began. Without one, now: then nothing is known to be in storage."""
        last = self.ledger.last_scan()
        return moment(last.began if last is not None else self.ledger.clock())


def largest(
    snapshot: Snapshot, expires: Mapping[str, float], owner: str | None, count: int
) -> list[StoredRecord]:
    """Return the largest records, largest first; with `owner`, only theirs.

    expires: when records reach their age, in seconds since 1970, by key.
    """
    holdings = [held for held in snapshot.holdings.values() if owner is None or held.owner == owner]
    holdings.sort(key=lambda held: (-held.size, held.key))
    return [
        StoredRecord(
            kind=held.kind,
            id=held.id,
            owner=held.owner,
            name=_name(snapshot, held),
            bytes=held.size,
            files=held.files,
            complete=held.whole or held.kind is not StoredKind.model,
            last_used=moment(snapshot.last_used[held.key]),
            needed_by=snapshot.needed.get(held.key),
            expires_at=moment(expires[held.key]) if held.key in expires else None,
        )
        for held in holdings[:count]
    ]


def _name(snapshot: Snapshot, held: Holding) -> str | None:
    """The name of a record now: jobs, and models with them, are renamed after their folders were read."""
    job = None if held.kind is StoredKind.capture else snapshot.jobs.get(held.id)
    return job.name if job is not None and job.readable else held.name


def moment(seconds: float) -> datetime:
    """Return seconds since 1970 as a point in time."""
    return datetime.fromtimestamp(seconds, UTC)


def _told_by(job: JobUse) -> list[Holding]:
    """Return the folders of a job and of its model, without their sizes, as the row of the job has them."""
    if not job.readable:
        return []
    kinds = (StoredKind.job, StoredKind.model)
    return [
        Holding(kind=kind, id=job.id, owner=job.owner, name=job.name, capture=job.capture) for kind in kinds
    ]


def _by_kind(account: Account) -> StoredBytes:
    sizes = dict.fromkeys(StoredKind, 0)
    for held in account.holdings:
        sizes[held.kind] += held.bytes if held.kind is StoredKind.capture else held.size
    return StoredBytes(
        captures=sizes[StoredKind.capture],
        sfm=sum(held.derived for held in account.holdings if held.kind is StoredKind.capture),
        jobs=sizes[StoredKind.job],
        models=sizes[StoredKind.model],
        uploads=account.uploads,
    )


def _count(account: Account, kind: StoredKind) -> int:
    return sum(1 for held in account.holdings if held.kind is kind and held.whole)


def _renewing(lock: Lock | None, entries: Iterable[Entry]) -> Iterator[Entry]:
    """Pass on what is listed, and renew the lock every few seconds."""
    renewed = time.monotonic()
    for entry in entries:
        yield entry
        if lock is not None and time.monotonic() - renewed > _LOCK_SECONDS / 5:
            renewed = time.monotonic()
            with suppress(LockError):  # lost to another process: two scans are as right as one
                lock.reacquire()


def _release(lock: Lock) -> None:
    with suppress(LockError):
        lock.release()

"""The sweeper: deletes what has reached its age, and what has no record. One API process at a time sweeps."""

import asyncio
import time
from collections.abc import Callable
from datetime import UTC, datetime

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import StoredKind
from splatmill_server.base.leases import lease
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.models import Models
from splatmill_server.space import leftovers
from splatmill_server.space.bin import Bin
from splatmill_server.space.deletion import Deletion
from splatmill_server.space.holdings import sums
from splatmill_server.space.job_uses import unfinished_jobs
from splatmill_server.space.retention import Ages, Planned, plan
from splatmill_server.space.snapshot import Snapshot
from splatmill_server.space.usage import Usage

log = structlog.get_logger()

MOST = 200
"""Records that one sweep deletes; the next one continues."""

_FIRST_SECONDS = 60.0
"""Seconds from the start of a process to its first sweep."""

_LEFTOVERS_SECONDS = 6 * 3600.0
"""Seconds between two searches of one process for leftovers in Redis and for files of broken writes."""


class Sweeper:
    """Sweeps every `interval` seconds."""

    def __init__(
        self,
        usage: Usage,
        deletion: Deletion,
        records_bin: Bin,
        captures: Captures,
        models: Models,
        ages: Ages,
        interval: float,
    ) -> None:
        self.usage = usage
        self.deletion = deletion
        self.bin = records_bin
        self.captures = captures
        self.models = models
        self.ages = ages
        self.interval = interval
        self._search_at = 0.0

    @property
    def connection(self) -> redis.Redis:
        """The connection to Redis."""
        return self.usage.connection

    @property
    def storage(self) -> Storage:
        """The storage that is swept."""
        return self.usage.storage

    async def run(self) -> None:
        """Sweep until this task is cancelled, also after errors."""
        await asyncio.sleep(min(_FIRST_SECONDS, self.interval))
        while True:
            try:
                async with lease(self.connection, "sweep", "storage") as mine:
                    if mine and await run_in_threadpool(self._is_turn):
                        await run_in_threadpool(self.sweep)
            except (redis.RedisError, StorageError) as error:
                log.warning("storage cannot be swept", error=str(error))
            except Exception:
                log.exception("sweep failed")
            await asyncio.sleep(self.interval)

    def _is_turn(self) -> bool:
        """Return whether no process has swept within the interval."""
        lasts = max(int(self.interval * 900), 1)  # milliseconds; a tenth less, so that no turn is missed
        return bool(self.connection.set(keys.SWEPT, 1, nx=True, px=lasts))

    def sweep(self) -> list[Planned]:
        """Delete what is due, and return it."""
        for record in self.deletion.finish():
            log.info("finished a deletion that was cut off", record=record)
        for binned in self.bin.delete_due(datetime.now(UTC)):
            log.info("deleted from the bin", kind=binned.kind.value, id=binned.id, owner=binned.owner)
        self.usage.refresh(self.interval / 2)
        snapshot = self.usage.snapshot()
        self._list_missing(snapshot)
        deleted = []
        for planned in plan(snapshot, self.ages, self.usage.ledger.clock())[:MOST]:
            if _safely(planned, lambda record=planned: self._delete(snapshot, record)):  # type: ignore[misc]  # bound at once
                deleted.append(planned)
                log.info(
                    "deleted",
                    what=planned.action,
                    id=planned.held.id,
                    owner=planned.held.owner,
                    bytes=planned.bytes,
                    reason=planned.reason,
                )
        if time.monotonic() >= self._search_at:
            self._search_at = time.monotonic() + _LEFTOVERS_SECONDS
            self.search()
        return deleted

    def _list_missing(self, snapshot: Snapshot) -> None:
        """List what was stored while Redis was away, or by somebody else."""
        for kind, listing in (
            (StoredKind.capture, self.captures.list_missing),
            (StoredKind.model, self.models.list_missing),
        ):
            whole = [held.id for held in snapshot.holdings.values() if held.kind is kind and held.whole]
            if listed := listing(sorted(whole)):
                log.info("listed", kind=kind.value, records=listed)

    def search(self) -> None:
        """Delete leftovers that are no records: of broken uploads and writes, and keys in Redis without their job."""
        counts = {
            "uploads": self.captures.delete_abandoned_uploads(),
            "broken writes": self.storage.delete_staged(self.ages.orphans),
            "digests": leftovers.delete_digests(self.storage, self.ages.orphans),
        }
        counts |= leftovers.tidy_redis(self.connection, self.ages.orphans)
        if any(counts.values()):
            log.info("deleted leftovers", **{name: count for name, count in counts.items() if count})

    def _delete(self, snapshot: Snapshot, planned: Planned) -> bool:
        """Delete one record, unless it was used since the plan was made. Return whether it was deleted."""

        def due() -> bool:
            return self._is_due(snapshot, planned)

        record_id = planned.held.id
        match planned.action:
            case "capture":
                return self.deletion.capture(record_id, due)
            case "job":
                return self.deletion.job(record_id, due)
            case "work":
                return self.deletion.work(record_id, due)
            case "orphan":
                return self.deletion.orphan(planned.held, due)

    def _is_due(self, snapshot: Snapshot, planned: Planned) -> bool:
        """Return whether the folder is as old as planned, now that no job can begin to use it."""
        held, now = planned.held, self.usage.ledger.clock()
        current = sums(self.storage.walk(held.folder)).get((held.kind, held.id), held)
        # Times of modification are whole seconds in a bucket.
        before, after = ((at.modified, at.files, at.size) for at in (held, current))
        if before != after or now < planned.due:
            return False
        if planned.action == "orphan":
            return not current.whole
        uses = unfinished_jobs(self.connection)
        if planned.action in ("capture", "job") and any(not use.readable for use in uses):
            return False
        if held.kind is StoredKind.capture:
            return not self.usage.ledger.arriving(held.owner or "", held.id, now)
        if held.kind is StoredKind.job and planned.action == "job":
            return not self.storage.exists(layout.job_record(held.id))  # it has a model since
        return True


def _safely(planned: Planned, delete: Callable[[], bool]) -> bool:
    """Return the result of a deletion. What refuses it is logged, so that it does not keep others from being deleted.

    Raises redis.RedisError, which affects all.
    """
    try:
        return delete()
    except ProblemError as error:
        log.info("not deleted", what=planned.action, id=planned.held.id, why=error.problem.detail)
    except StorageError as error:
        log.warning("cannot be deleted", what=planned.action, id=planned.held.id, error=str(error))
    return False

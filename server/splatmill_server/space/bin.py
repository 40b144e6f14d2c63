"""The bin: jobs with their models, and captures, that are deleted for good a day after they were put there.

    bin/{kind}.{id}.json: a `Binned`

Storage is the truth. Redis holds the same, for lists, and gets it again where it has lost it (`make`).
"""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import redis
import structlog

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import read_record
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import BinKind, Binned
from splatmill_server.base.lists import each
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.jobs.records import Jobs
from splatmill_server.space.deletion import Deletion

log = structlog.get_logger()

KEPT = timedelta(days=1)
"""Time for which a record stays in the bin."""


class Bin:
    """What is in the bin. Methods raise ProblemError, StorageError, and redis.RedisError if Redis cannot be reached."""

    def __init__(
        self, connection: redis.Redis, storage: Storage, captures: Captures, jobs: Jobs, deletion: Deletion
    ) -> None:
        self.connection = connection
        self.storage = storage
        self.captures = captures
        self.jobs = jobs
        self.deletion = deletion

    def put_job(self, job_id: str) -> Binned:
        """Put a job that has ended into the bin, with its model. One that is there already stays as it is.

        Raises problems for a job that does not exist (404), that has not ended (409), or whose model another unfinished
        job starts from (409).
        """
        job = self.jobs.get(job_id)
        if not job.state.final:
            raise ProblemError(
                "job_running",
                f"The job has not ended; its state is {job.state.value}.",
                advice="Cancel it with POST /v1/jobs/{id}/cancel first.",
                facts={"state": job.state.value},
            )
        self.deletion.check_model_unused(job_id)
        return self._put(BinKind.job, job_id, job.name, job.owner, job.model)

    def put_capture(self, capture_id: str) -> Binned:
        """Put a capture into the bin. One that is there already stays as it is.

        Raises problems for a capture that does not exist (404) or that an unfinished job uses (409).
        """
        capture = self.captures.get(capture_id)
        self.deletion.check_capture_unused(capture_id)
        return self._put(BinKind.capture, capture_id, capture.name, capture.owner, None)

    def _put(self, kind: BinKind, record_id: str, name: str | None, owner: str, model: str | None) -> Binned:
        now = datetime.now(UTC)
        binned = Binned(
            kind=kind,
            id=record_id,
            name=name,
            owner=owner,
            model=model,
            binned_at=now,
            deleted_at=now + KEPT,
        )
        path = layout.binned(kind, record_id)
        if not self.storage.put_new(path, binned.model_dump_json().encode()):
            binned = self._read(path) or binned
        self.connection.hset(keys.BIN, _field(binned), binned.model_dump_json())
        return binned

    def restore(self, kind: BinKind, record_id: str) -> None:
        """Take a record out of the bin. Raises a 404 problem if it is not there."""
        if not self.take_out(kind, record_id):
            raise ProblemError(
                "not_in_bin",
                f"The {kind.value} {record_id[:80]!r} is not in the bin.",
                advice="GET /v1/bin lists its entries. What has been there for a day is deleted for good.",
            )

    def take_out(self, kind: BinKind, record_id: str) -> bool:
        """Take a record out of the bin, and return whether it was there."""
        path = layout.binned(kind, record_id)
        there = layout.is_id(record_id) and self.storage.exists(path)
        if there:
            self.storage.delete(path)
            self.connection.hdel(keys.BIN, keys.in_bin(kind, record_id))
        return there

    def list(self, owner: str | None) -> list[Binned]:
        """Return what is in the bin, of one owner if that is given, the newest first."""
        entries = [Binned.model_validate_json(record) for record in self._records()]
        mine = [entry for entry in entries if owner is None or entry.owner == owner]
        return sorted(mine, key=lambda entry: (entry.binned_at, entry.id), reverse=True)

    def _records(self) -> Sequence[bytes]:
        return cast(list[bytes], self.connection.hvals(keys.BIN))

    def make(self, succeeded: object = None) -> int:
        """Put into Redis what storage has of the bin, and return the number of records (see `Lists.makers`)."""
        paths = [entry.path for entry in self.storage.entries(layout.bin_folder())]
        binned = [entry for entry in each(self._read, paths) if entry is not None]
        stored = {_field(entry): entry.model_dump_json() for entry in binned}
        if stored:
            self.connection.hset(keys.BIN, mapping=cast(Any, stored))
        for field in cast(list[bytes], self.connection.hkeys(keys.BIN)):
            kind, _, record_id = field.decode().partition("/")
            if field.decode() not in stored and not self.storage.exists(layout.binned(kind, record_id)):
                self.connection.hdel(keys.BIN, field)
        return len(stored)

    def delete_due(self, now: datetime) -> Sequence[Binned]:
        """Delete for good what has been in the bin long enough, and return it. What a job uses again stays a while."""
        self.make()
        deleted = []
        for entry in self.list(None):
            if entry.deleted_at > now:
                continue

            def still(entry: Binned = entry) -> bool:
                return self.storage.exists(layout.binned(entry.kind, entry.id))

            delete = self.deletion.job if entry.kind is BinKind.job else self.deletion.capture
            try:
                if delete(entry.id, still):
                    deleted.append(entry)
            except ProblemError as error:
                if error.problem.status == 404:
                    self.take_out(entry.kind, entry.id)  # it was deleted by itself
                else:
                    log.info("stays in the bin", kind=entry.kind.value, id=entry.id, why=error.problem.detail)
            except StorageError as error:
                log.warning("cannot be deleted", kind=entry.kind.value, id=entry.id, error=str(error))
        return deleted

    def _read(self, path: str) -> Binned | None:
        """Return a record of the bin, or None for one that is gone or cannot be read, which deletes nothing."""
        return read_record(self.storage, path, Binned, "is not read as a record of the bin")


def _field(binned: Binned) -> str:
    return keys.in_bin(binned.kind, binned.id)

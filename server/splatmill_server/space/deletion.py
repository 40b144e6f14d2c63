"""Deletes captures and jobs, unless an unfinished job needs them. Whoever deletes a record does it through here.

A deletion and the creation of a job that needs the record can meet. The deletion first sets a mark in Redis and then
looks for unfinished jobs; a job is inserted in a transaction that fails if the mark appears. So one of the two always
sees the other. A deletion that is cut off stays noted, and the next sweep finishes it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import cast

import redis

from splatmill.backplane import keys, lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import UnreadableRecord
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import BinKind, Capture, StoredKind
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.jobs.records import Jobs
from splatmill_server.space.holdings import Holding
from splatmill_server.space.job_uses import JobUse, unfinished_jobs
from splatmill_server.space.ledger import Ledger

DELETING, DELETED = b"deleting", keys.DELETED
"""Values of a mark: files are being deleted, or they are gone, unless the record was made anew under the same id."""

_MARK_SECONDS = 600
"""Seconds for which a mark stays. It must outlast any creation of a job that began before the deletion did."""


class Deletion:
    """Deletes records. Methods raise ProblemError, StorageError, and redis.RedisError if Redis cannot be reached."""

    def __init__(
        self, connection: redis.Redis, storage: Storage, captures: Captures, jobs: Jobs, ledger: Ledger
    ) -> None:
        self.connection = connection
        self.storage = storage
        self.captures = captures
        self.jobs = jobs
        self.ledger = ledger

    def capture(self, capture_id: str, still: Callable[[], bool] | None = None) -> bool:
        """Delete a capture and its files. Return False if `still`, called when no job can use it any more, does.

        Raises problems for a capture that does not exist (404) or that an unfinished job uses (409).
        """
        owner = self._owner(capture_id)
        record = Holding(kind=StoredKind.capture, id=capture_id).key
        with self._marked(record) as mark:
            self.check_capture_unused(capture_id)
            if still is not None and not still():
                return False
            mark.begin()
            self.captures.delete(capture_id)
            self._leave_bin(BinKind.capture, capture_id)
            self.ledger.deleted(StoredKind.capture, capture_id, owner)
        return True

    def job(self, job_id: str, still: Callable[[], bool] | None = None) -> bool:
        """Delete a job that has ended, with its model. Return False if `still` does, as for `capture`.

        Raises problems for a job that does not exist (404), that has not ended (409), or whose model another unfinished
        job starts from (409).
        """
        owner = self.jobs.get_owner(job_id)
        model = Holding(kind=StoredKind.model, id=job_id).key
        with self._marked(model) as mark:
            self.check_model_unused(job_id)
            if still is not None and not still():
                return False
            mark.begin()
            self.jobs.delete(
                job_id
            )  # refuses a job that has not ended; its links open nothing without the model
            self.storage.delete_prefix(layout.shares_of(job_id))
            self._leave_bin(BinKind.job, job_id)
            for kind in (StoredKind.job, StoredKind.model):
                self.ledger.deleted(kind, job_id, owner)
        return True

    def check_capture_unused(self, capture_id: str) -> None:
        """Raise a 409 problem if an unfinished job uses a capture."""
        if (use := self._user(Holding(kind=StoredKind.capture, id=capture_id).key)) is not None:
            raise ProblemError(
                "capture_in_use",
                f"The job {use.id} uses this capture and has not ended.",
                advice=f"Cancel it with POST /v1/jobs/{use.id}/cancel, or wait until it has ended.",
                facts={"job": use.id},
            )

    def check_model_unused(self, job_id: str) -> None:
        """Raise a 409 problem if another unfinished job starts from the model of a job."""
        use = self._user(Holding(kind=StoredKind.model, id=job_id).key)
        if use is not None and use.id != job_id:
            raise ProblemError(
                "model_in_use",
                f"The job {use.id} starts from the model of this job and has not ended.",
                advice=f"Cancel it with POST /v1/jobs/{use.id}/cancel, or wait until it has ended.",
                facts={"job": use.id},
            )

    def _leave_bin(self, kind: BinKind, record_id: str) -> None:
        """Take a record that is deleted from the bin."""
        self.storage.delete(layout.binned(kind, record_id))
        self.connection.hdel(keys.BIN, keys.in_bin(kind, record_id))

    def work(self, job_id: str, still: Callable[[], bool]) -> bool:
        """Delete the files from which a job that has ended would resume. Return False if `still` does."""
        model = Holding(kind=StoredKind.model, id=job_id).key
        with self._marked(model):
            if any(use.id == job_id for use in unfinished_jobs(self.connection)) or not still():
                return False
            self.storage.delete_prefix(layout.job_work(job_id))
        return True

    def orphan(self, held: Holding, still: Callable[[], bool]) -> bool:
        """Delete a folder whose record is missing. Return False if `still` does, or if a job needs it."""
        with self._marked(held.key) as mark:
            if self._user(held.key) is not None or not still():
                return False
            mark.begin()
            if held.kind is StoredKind.model:
                self.storage.delete_prefix(layout.shares_of(held.id))
            self.storage.delete_prefix(held.folder)
            self.ledger.deleted(held.kind, held.id, held.owner)
        return True

    def unused_capture(self, capture: Capture) -> None:
        """Delete a capture that nobody else knows yet, also while Redis cannot be reached."""
        with suppress(
            redis.RedisError
        ):  # it is not listed without its record, and the next scan corrects the figures
            self.captures.delete(capture.id)
            self.ledger.deleted(StoredKind.capture, capture.id, capture.owner)

    def finish(self) -> list[str]:
        """Finish the deletions that were cut off, and return the keys of their records."""
        finished = []
        for field in cast(list[bytes], self.connection.hkeys(keys.DELETIONS)):
            record = field.decode()
            if self.connection.get(keys.deleting(record)) == DELETING:
                continue  # another process may be at it
            kind, _, record_id = record.partition("/")
            is_capture = kind == StoredKind.capture.value
            try:
                (self.capture if is_capture else self.job)(record_id)
            except ProblemError as error:
                if (
                    error.problem.status == 404
                ):  # its record was deleted, and files and entries of lists may be left
                    if is_capture:
                        self.captures.unlist(record_id, None)
                    else:
                        lists.remove_model(self.connection, record_id, None)
                    for path in (
                        (layout.capture(record_id),)
                        if is_capture
                        else (layout.shares_of(record_id), layout.model(record_id), layout.job(record_id))
                    ):
                        self.storage.delete_prefix(path)
                    finished.append(record)
            else:
                finished.append(record)
            self.connection.hdel(keys.DELETIONS, record)
        return finished

    def _owner(self, capture_id: str) -> str | None:
        try:
            return self.captures.get(capture_id).owner
        except UnreadableRecord:
            return None

    def _user(self, record: str) -> JobUse | None:
        return next((use for use in unfinished_jobs(self.connection) if record in use.records), None)

    @contextmanager
    def _marked(self, record: str) -> Iterator["_Mark"]:
        mark = _Mark(self.connection, record)
        mark.set()
        try:
            yield mark
        except ProblemError:
            mark.remove()
            raise
        if mark.begun:
            mark.end()
        else:
            mark.remove()


class _Mark:
    """The mark of one deletion, and the note that it has begun."""

    def __init__(self, connection: redis.Redis, record: str) -> None:
        self.connection = connection
        self.record = record
        self.begun = False
        self._mine = False

    def set(self) -> None:
        """Keep new jobs from using the record."""
        name = keys.deleting(self.record)
        self._mine = bool(self.connection.set(name, DELETING, ex=_MARK_SECONDS, nx=True))
        if not self._mine and self.connection.get(name) != DELETING:
            self._mine = bool(self.connection.set(name, DELETING, ex=_MARK_SECONDS))

    def begin(self) -> None:
        """Note that files are deleted from here on, so that a sweep finishes it if this process cannot."""
        self.begun = True
        self.connection.hset(keys.DELETIONS, self.record, "begun")

    def end(self) -> None:
        """Note that the record is deleted."""
        self.connection.set(keys.deleting(self.record), DELETED, ex=_MARK_SECONDS)
        self.connection.hdel(keys.DELETIONS, self.record)

    def remove(self) -> None:
        """Let jobs use the record again, unless another process deletes it."""
        if self._mine:
            self.connection.delete(keys.deleting(self.record))
        if self.begun:
            self.connection.hdel(keys.DELETIONS, self.record)

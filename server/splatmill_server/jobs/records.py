"""The records of jobs: makes, restarts, cancels, ends and deletes them. No other code writes job rows, but for
what `labels` writes.

Each change is one optimistic transaction on the row, and on the states stream if the change depends on it, so that
API processes and workers never overwrite each other's changes.
"""

import hashlib
import json
import secrets
from collections.abc import Callable, Sequence
from typing import Any, cast

import redis
import structlog

from splatmill.backplane import keys, lists
from splatmill.backplane.jobs import events, row
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow, Verdict
from splatmill.backplane.queue import queue
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import UnreadableRecord, check_format, reason, warn
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import DEFAULT_OWNER, ChangeLabels, CreateJob, Job, JobPage, JobState, Problem
from splatmill.schema.tolerant import keep_readable
from splatmill_server.access.caller import Caller
from splatmill_server.base.filters import JobFilter
from splatmill_server.base.leases import exclusive
from splatmill_server.base.lists import Ended, Lists
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs import curve as job_curve
from splatmill_server.jobs import labels, listing, outcome, requests, restoring, shrinking
from splatmill_server.jobs import log as job_log
from splatmill_server.jobs.links import with_links
from splatmill_server.jobs.queue_places import QueuePlaces
from splatmill_server.jobs.reading import read_jobs

log = structlog.get_logger()

IDEMPOTENCY_DAYS = 7
_TOGETHER = 500
"""Number of unfinished jobs that are read in one round trip."""


class Jobs:
    """All operations on jobs. Methods raise ProblemError, and redis.RedisError if Redis cannot be reached."""

    def __init__(self, connection: redis.Redis, storage: Storage, metrics: Metrics, listed: Lists) -> None:
        self.connection = connection
        self.storage = storage
        self.metrics = metrics
        self.lists = listed
        self._places = QueuePlaces(connection)
        self.on_end: list[Callable[[Job, int], None]] = []
        """Called with a job that has ended, and its generation, before it is forgotten that it was unfinished.

        A function may be called several times for one end, and by several processes.
        """

    def create(
        self,
        request: CreateJob,
        *,
        owner: str,
        key: str | None = None,
        body: str = "",
        check: Callable[[], None] | None = None,
        watched: Sequence[str] = (),
    ) -> tuple[Job, bool]:
        """Create a job; return it, and whether it is new.

        check: raises what keeps the job from being made. It is called in the transaction that inserts the job, and
            again if one of the keys `watched`, or the number of jobs that the owner has begun, changed meanwhile.

        With an `Idempotency-Key` that this owner used before, return the job of that request. `body` identifies the
        request: the same key with another body raises a 409 problem.
        """
        job_id = secrets.token_hex(8)
        if key is not None:
            job_id = self._claim_key(owner, key, hashlib.sha256(body.encode()).hexdigest(), job_id)
        moment = row.now()
        new = JobRow(
            id=job_id,
            capture=request.capture,
            name=request.name,
            owner=owner,
            options=request.options,
            priority=request.priority,
            created_at=moment,
            queued_at=moment,
            request=_request_id(),
        )
        if (known := row.read(self.connection, job_id)) is not None:
            return self._placed(known), False

        def insert(pipe: Any) -> None:
            nonlocal known
            known = row.read(self.connection, job_id)
            if known is None and check is not None:
                check()
            pipe.multi()
            if known is None:
                pipe.incr(keys.begun_jobs(owner))
                pipe.hset(keys.job(job_id), mapping=new.fields())
                created = lists.milliseconds(moment)
                lists.put_job(pipe, job_id, created, owner, request.capture, lists.UNFINISHED)
                pipe.sadd(keys.ACTIVE, job_id)

        requests.save(self.storage, new)
        try:
            # Of two concurrent requests with the same key, only one inserts the job.
            self.connection.transaction(insert, keys.job(job_id), keys.begun_jobs(owner), *watched)
        except BaseException:
            self._correct_request(job_id)
            raise
        if known is not None and (known.capture, known.created_at) != (new.capture, new.created_at):
            self._correct_request(job_id)
            return self._placed(known), False
        # Otherwise the row is that of this request, also where a request at the same moment has restored it.
        # A crash here leaves a row that is not in the queue; the reaper enqueues it.
        queue.enqueue(self.connection, job_id, new.generation)
        self.metrics.created.inc()
        log.info("job created", job=job_id, capture=request.capture)
        return self._placed(new), True

    def _correct_request(self, job_id: str) -> None:
        """Store the row of a job again, where a request that did not make it has just stored its own."""
        if (made := row.read(self.connection, job_id)) is not None:
            requests.save(self.storage, made)
        else:
            self.storage.delete(layout.unfinished_job(job_id))

    def get_id_of_key(self, owner: str, key: str) -> str | None:
        """Return the id of the job that the owner first used an `Idempotency-Key` for, or None."""
        stored = cast(bytes | None, self.connection.get(keys.idempotency(_digest(owner, key))))
        return cast(str, json.loads(stored)["job"]) if stored else None

    def get_row(self, job_id: str) -> JobRow:
        """Return the row of a job. Raises a 404 problem if there is none, and a 500 problem if it is not readable.

        An unfinished job that Redis has lost, as one that stops without its last second of writes does, is restored.
        """
        try:
            job_row = row.read(self.connection, job_id) if layout.is_id(job_id) else None
            if job_row is None and layout.is_id(job_id) and self.restore([job_id]):
                job_row = row.read(self.connection, job_id)
        except UnreadableRecord as error:
            raise ProblemError(
                "job_corrupt",
                f"The record of the job {job_id} cannot be read: {error}.",
                advice="It was probably written by a later version of the server; run that version, or delete the "
                "job.",
            ) from error
        if job_row is None:
            raise job_not_found(job_id)
        return job_row

    def check_visible(self, who: Caller, job_id: str) -> None:
        """Raise a 404 problem if another owner has the job, but not if there is none."""
        if not who.admin and not who.may_see(self.get_owner(job_id)):
            raise job_not_found(job_id)

    def get_owner(self, job_id: str) -> str | None:
        """Return the owner of a job, or None if there is no such job or its owner cannot be read."""
        if not layout.is_id(job_id):
            return None
        known, owner = self._owners([job_id])[0]
        if not known and self.restore([job_id]):
            known, owner = self._owners([job_id])[0]
        if known:
            return owner
        stored = self.get_stored(job_id)
        return stored.owner if stored is not None else None

    def _owners(self, job_ids: Sequence[str]) -> list[tuple[bool, str]]:
        """Return, for each id, whether there is a row, and its owner. A row that is not readable has its owner too."""
        with self.connection.pipeline(transaction=False) as pipe:
            for job_id in job_ids:
                pipe.hmget(keys.job(job_id), "id", "owner")
            replies = pipe.execute()
        return [
            (known is not None, owner.decode("utf-8", "replace") if owner is not None else DEFAULT_OWNER)
            for known, owner in replies
        ]

    def get(self, job_id: str) -> Job:
        """Return the job as clients see it. A job that has ended is read from storage if Redis has lost it."""
        if layout.is_id(job_id) and (held := read_jobs(self.connection, [job_id]).get(job_id)) is not None:
            return self._places.fill([(with_links(held.job()), held.row.generation)])[0]
        if (stored := self.get_stored(job_id)) is not None:
            return stored
        return self._placed(self.get_row(job_id))  # raises what is wrong with the row, or that there is none

    def get_stored(self, job_id: str) -> Job | None:
        """Return an ended job from storage: from the `job.json` of its model or the file of its log, or None."""
        if not layout.is_id(job_id):
            return None
        try:
            return with_links(read_record(self.storage, job_id))
        except FileNotFoundError:
            pass
        except UnreadableRecord as error:
            warn(layout.job_record(job_id), str(error))
        ended = job_log.get_stored_end(self.storage, job_id)
        return with_links(ended.job) if ended is not None else None

    def list(
        self, cursor: str | None, limit: int, only: JobFilter | None = None, by: listing.By = listing.NEWEST
    ) -> JobPage:
        """Return a page of the jobs that `only` admits, in the order `by` (see `listing.page`)."""
        only = only or JobFilter()
        return listing.page(self.connection, self.lists, self._places, cursor, limit, only, by)

    def make_lists(self, succeeded: dict[str, Ended]) -> int:
        """List all jobs, restore those that storage alone knows, and return their number (see `Lists.makers`)."""
        return restoring.make_lists(self.connection, self.storage, self.lists, succeeded)

    def restore(self, job_ids: Sequence[str]) -> int:
        """Restore those of these unfinished jobs that Redis has lost, and return their number."""
        return restoring.restore_unfinished(self.connection, self.storage, job_ids)

    def list_active(self) -> Sequence[JobRow]:
        """Return the rows of all unfinished jobs, and retire those that have ended.

        A job whose row is not readable stays active, but is left out.
        """
        ids = sorted(entry.decode() for entry in cast(set[bytes], self.connection.smembers(keys.ACTIVE)))
        rows = []
        for start in range(0, len(ids), _TOGETHER):
            batch = ids[start : start + _TOGETHER]
            held = read_jobs(self.connection, batch)
            for job_id in batch:
                if job_id in held and not held[job_id].state.final:
                    rows.append(held[job_id].row)
                elif job_id in held or not self.connection.exists(keys.job(job_id)):
                    self.retire(job_id)
        return rows

    def retire(self, job_id: str) -> None:
        """Store the log of a job that has ended, announce its end, and remove it from the set of active ones.

        The job stays active if its log or its end cannot be stored, which is then tried again, or if it was restarted,
        or restored from storage, meanwhile. The request of a job whose row is lost is kept.
        """
        announced: int | None = None
        try:
            if (known := row.read(self.connection, job_id)) is not None and (
                job := self._job(known)
            ).state.final:
                job_log.save(self.connection, self.storage, job, known.generation)
                job_curve.save(self.connection, self.storage, job_id)
                if (
                    job.state is JobState.succeeded
                    and self.connection.zscore(lists.name("models"), job_id) is None
                ):
                    # Its worker was killed between the model and the list.
                    lists.add_model(self.connection, job_id, job.finished_at or job.created_at, known.owner)
                self._announce_end(known)
                announced = known.generation
        except StorageError as error:
            log.warning("the end of a job cannot be stored", job=job_id, error=str(error))
            return
        retired: JobRow | None = None
        moment = self.connection.time()[0]

        def remove(pipe: Any) -> None:
            nonlocal retired
            known = row.read(self.connection, job_id)
            states = events.read_states(self.connection, job_id)
            state = fold(known, states).state if known else None
            told = known is not None and known.generation == announced
            retired = known if told and state is not None and state.final else None
            pipe.multi()
            if known is None:
                pipe.srem(keys.ACTIVE, job_id)
            elif retired is not None and state is not None:
                outcome.retire(pipe, retired, states)
                created = lists.milliseconds(retired.created_at)
                lists.put_job(pipe, job_id, created, retired.owner, retired.capture, state.value)
                shrinking.note(pipe, job_id, moment)

        self.connection.transaction(remove, keys.job(job_id), keys.states(job_id))
        if retired is not None:
            try:
                requests.delete(self.connection, self.storage, retired)
            except StorageError as error:  # what is left shows nothing: the log in storage has the end
                log.warning("the request of an ended job cannot be deleted", job=job_id, error=str(error))

    def _announce_end(self, job_row: JobRow) -> None:
        """Tell that a job has ended, if it has. Raises StorageError if that cannot be stored."""
        job = self._job(job_row)
        if not job.state.final:
            return
        for ended in self.on_end:
            try:
                ended(job, job_row.generation)
            except StorageError:
                raise
            except Exception:  # other jobs must still be looked after
                log.exception("the end of a job could not be announced", job=job_row.id)

    def _announce_unretired(self, job_id: str) -> None:
        """Announce the end of a job that has ended so recently that it still counts as active."""
        if self.connection.sismember(keys.ACTIVE, job_id):
            self._announce_end(self.get_row(job_id))

    def count_unfinished(self, owner: str) -> int:
        """Return the number of unfinished jobs of an owner. A job whose row is not readable is one of them."""
        named = lists.name("jobs", owner=owner, group=lists.UNFINISHED)
        own = [entry.decode() for entry in cast(list[bytes], self.connection.zrange(named, 0, -1))]
        return len(own) - sum(held.state.final for held in read_jobs(self.connection, own).values())

    def cancel(self, job_id: str) -> Job:
        """Record the request to cancel a job. The reaper then kills its process and ends the job."""

        def request_cancel(job_row: JobRow, job: Job) -> dict[str, str] | None:
            if job.state is JobState.cancelled or job_row.cancel_requested_at is not None:
                return None
            if job.state.final:
                raise ProblemError(
                    "job_finished",
                    f"The job has already ended: it {_ended(job)}.",
                    advice="Delete it with DELETE /v1/jobs/{id} if it is no longer needed.",
                    facts={"state": job.state.value},
                )
            return {"cancel_requested_at": row.now().isoformat()}

        return self._change(job_id, request_cancel)

    def waiting(self, job_id: str) -> Job | None:
        """Return a job that waits, which a restart leaves as it is, or None for one that has ended.

        Raises 404 problems, and a 409 problem for a job that runs.
        """
        job_row = self.get_row(job_id)
        return self._placed(job_row) if _waits(job_row, self._job(job_row)) else None

    def label(self, job_id: str, change: ChangeLabels) -> Job:
        """Change the labels of a job, and of its model with it. Raises a 404 problem if there is no such job."""
        self.get(job_id)
        with exclusive(self.connection, "labels", job_id):
            job = self.get(job_id)
            known = labels.get(self.storage, job_id)
            known = known or labels.Labels(name=job.name, tags=job.tags, favourite=job.favourite)
            after = known.model_copy(update=change.model_dump(exclude_unset=True))
            labels.save(
                self.storage, job_id, after
            )  # first: a job that Redis loses from here on is restored with it
            labels.write(self.connection, job_id, after)
        try:
            return self.get(job_id)
        except ProblemError:
            labels.delete(self.storage, job_id)  # the job was deleted meanwhile
            raise

    def restart(self, job_id: str, *, check: Callable[[], None], watched: Sequence[str]) -> Job:
        """Enqueue a job that has ended as a new generation, which resumes from its checkpoint if there is one.

        check, watched: as for `create`.
        """

        def begin_generation(job_row: JobRow, job: Job) -> dict[str, str] | None:
            if _waits(job_row, job):
                return None  # a repeated restart has no further effect
            check()
            moment = row.now()
            requests.save(self.storage, requests.next_generation(job_row, moment, _request_id()))
            return {
                "generation": str(job_row.generation + 1),
                "queued_at": moment.isoformat(),
                "cancel_requested_at": "",
                "verdict": "",
                "request": _request_id() or "",
            }

        self._announce_unretired(job_id)
        self._change(job_id, begin_generation, *watched, begun=keys.begun_jobs(self.get_row(job_id).owner))
        begun = self.get_row(job_id)
        requests.save(self.storage, begun)  # again: the end of the former generation may just have removed it
        queue.enqueue(self.connection, job_id, begun.generation)
        log.info("job restarted", job=job_id, generation=begun.generation)
        return self._placed(begun)

    def delete(self, job_id: str) -> None:
        """Delete a job that has ended, its work files and its model. Raises 404 and 409 problems."""
        owner, capture = self.get_owner(job_id), None
        job_row: JobRow | None = None
        try:
            job_row = self.get_row(job_id)
        except ProblemError as error:
            if error.problem.code == "job_corrupt":
                self._withdraw_unreadable(job_id)
            elif (ended := self.get_stored(job_id)) is None:
                raise
            else:
                capture = ended.capture
        else:
            capture = job_row.capture
            job = self._job(job_row)
            if not job.state.final:
                raise ProblemError(
                    "job_running",
                    f"The job has not ended; its state is {job.state.value}.",
                    advice="Cancel it with POST /v1/jobs/{id}/cancel first.",
                    facts={"state": job.state.value},
                )
            self._announce_unretired(job_id)
            for generation in range(1, job_row.generation + 1):
                queue.forget(self.connection, job_id, generation)
        states = events.read_states(self.connection, job_id)
        self.storage.delete(layout.unfinished_job(job_id))
        # The record goes first, so that no model with missing files is visible.
        self.storage.delete(layout.job_record(job_id))
        self.storage.delete_prefix(layout.model(job_id))
        self.storage.delete_prefix(layout.job(job_id))
        labels.delete(self.storage, job_id)
        with self.connection.pipeline(transaction=True) as pipe:
            pipe.delete(*keys.of_job(job_id))
            lists.remove_job(pipe, job_id, owner, capture)
            lists.remove(pipe, "models", job_id, owner)
            pipe.hdel(keys.records("models"), job_id)
            if job_row is not None:  # it may have ended so lately that it still counts as unfinished
                outcome.retire(pipe, job_row, states)
            pipe.srem(keys.ACTIVE, job_id)
            pipe.zrem(keys.UNSHRUNK, job_id)
            pipe.execute()

    def _withdraw_unreadable(self, job_id: str) -> None:
        """Remove a job whose row is not readable from the queue. Raises a 409 problem while a worker runs it."""
        stored = cast(bytes | None, self.connection.hget(keys.job(job_id), "generation")) or b"1"
        for generation in range(1, (int(stored) if stored.isdigit() else 1) + 1):
            if queue.status(self.connection, job_id, generation).state == "running":
                raise ProblemError(
                    "job_running",
                    f"A worker runs the job {job_id}, whose record cannot be read.",
                    advice="Delete it when the worker has ended it, or stop the worker first.",
                )
            queue.withdraw(self.connection, job_id, generation)
            queue.forget(self.connection, job_id, generation)

    def give_verdict(self, expected: JobRow, state: str, problem: Problem | None = None) -> bool:
        """End a generation as `state`; return False if it has ended, was restarted, or is to be cancelled, meanwhile.

        A process that is killed for a cancellation that `expected` does not know yet looks like a failure.
        """
        decided = False

        def verdict(job_row: JobRow, job: Job) -> dict[str, str] | None:
            nonlocal decided
            expects = expected.generation, expected.cancel_requested_at
            decided = not job.state.final and (job_row.generation, job_row.cancel_requested_at) == expects
            if not decided:
                return None
            last = cast(list[Any], self.connection.xrevrange(keys.states(job_row.id), count=1))
            after = last[0][0].decode() if last else events.START
            ending = Verdict(state=cast(Any, state), at=row.now(), after=after, problem=problem)
            return {"verdict": ending.model_dump_json(exclude_none=True)}

        self._change(expected.id, verdict)
        return decided

    def _job(self, job_row: JobRow) -> Job:
        states = events.read_states(self.connection, job_row.id)
        return with_links(fold(job_row, states, events.last_progress(self.connection, job_row.id)))

    def _placed(self, job_row: JobRow) -> Job:
        return self._places.fill([(self._job(job_row), job_row.generation)])[0]

    def _change(
        self,
        job_id: str,
        decide: Callable[[JobRow, Job], dict[str, str] | None],
        *watched: str,
        begun: str | None = None,
    ) -> Job:
        """Apply the changes that `decide` returns for the row and the job, and return the job.

        `decide` returns new values of fields, where an empty value deletes the field, or None for no change. It is
        called again if the row, the states or the keys `watched` changed meanwhile.
        """

        def apply(pipe: Any) -> None:
            job_row = self.get_row(job_id)
            changes = decide(job_row, self._job(job_row))
            begins = changes is not None and "generation" in changes
            states = events.read_states(self.connection, job_id) if begins else []
            pipe.multi()
            if changes is None:
                return
            kept = {name: value for name, value in changes.items() if value}
            deleted = [name for name, value in changes.items() if not value]
            if begun is not None:
                pipe.incr(begun)
            pipe.hset(keys.job(job_id), mapping=kept)
            if begins:
                # The end of the former generation, if nobody has seen it yet.
                outcome.retire(pipe, job_row, states)
                pipe.sadd(keys.ACTIVE, job_id)
                pipe.zrem(keys.UNSHRUNK, job_id)
                created = lists.milliseconds(job_row.created_at)
                lists.put_job(pipe, job_id, created, job_row.owner, job_row.capture, lists.UNFINISHED)
            if deleted:
                pipe.hdel(keys.job(job_id), *deleted)

        watched_keys = [
            keys.job(job_id),
            keys.states(job_id),
            *watched,
            *([begun] if begun is not None else []),
        ]
        self.connection.transaction(apply, *watched_keys)
        return self._placed(self.get_row(job_id))

    def _claim_key(self, owner: str, key: str, body: str, job_id: str) -> str:
        name = keys.idempotency(_digest(owner, key))
        value = json.dumps({"job": job_id, "body": body})
        if self.connection.set(name, value, nx=True, ex=IDEMPOTENCY_DAYS * 86400):
            return job_id
        known = json.loads(cast(bytes, self.connection.get(name)) or value)
        if known["body"] != body:
            raise ProblemError(
                "idempotency_conflict",
                "This Idempotency-Key was already used for a request with another body.",
                advice="Use a new key for a new request, and the same key only to repeat a request.",
                facts={"job": known["job"]},
            )
        return cast(str, known["job"])


def _waits(job_row: JobRow, job: Job) -> bool:
    """Return whether a job waits, rather than having ended. Raises a 409 problem if it does neither."""
    if job.state is JobState.queued and job_row.cancel_requested_at is None:
        return True
    if not job.state.final:
        raise ProblemError(
            "job_running",
            f"The job has not ended; its state is {job.state.value}.",
            advice="Cancel it first, or wait until it has ended.",
            facts={"state": job.state.value},
        )
    return False


def read_record(storage: Storage, job_id: str, labelled: frozenset[str] | None = None) -> Job:
    """Return the job in the `job.json` of a model, without what is not readable in it, under its labels.

    labelled: the jobs that were given labels, where they are known.

    Raises FileNotFoundError, and UnreadableRecord.
    """
    return read_model_record(storage, job_id, labelled)[0]


def read_model_record(
    storage: Storage, job_id: str, labelled: frozenset[str] | None = None
) -> tuple[Job, dict[str, Any]]:
    """Return the job in the `job.json` of a model, as `read_record` does, and all fields of that file."""
    try:
        record = json.loads(storage.get(layout.job_record(job_id)))
        check_format(record)
        job, left_out = keep_readable(Job.model_validate, record)
    except (ValueError, TypeError, AttributeError) as error:
        raise UnreadableRecord(f"job.json cannot be read: {reason(error)}") from error
    if left_out:
        warn(layout.job_record(job_id), f"left out what cannot be read: {'; '.join(left_out)[:300]}")
    return labels.under(storage, job_id, job, labelled), record


def last_stage(job: Job) -> str | None:
    """Return the stage of the job's last progress, or None."""
    return job.progress.stage if job.progress is not None else None


def _ended(job: Job) -> str:
    return "was cancelled" if job.state is JobState.cancelled else job.state.value


def job_not_found(job_id: str) -> ProblemError:
    """Return the 404 problem for an id without a job."""
    return ProblemError(
        "job_not_found",
        f"There is no job {job_id[:80]!r}.",
        advice="List the jobs with GET /v1/jobs.",
    )


def _request_id() -> str | None:
    """Return the id of the request that is being answered, as the middleware has bound it to the log."""
    return cast(str | None, structlog.contextvars.get_contextvars().get("request"))


def _digest(owner: str, key: str) -> str:
    # Keys stored before there were owners have no owner in their digest. No header value has a NUL.
    named = key if owner == DEFAULT_OWNER else f"{owner}\0{key}"
    return hashlib.sha256(named.encode()).hexdigest()

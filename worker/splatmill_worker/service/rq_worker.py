"""RQ's worker, extended for attempts that spend hours in native code.

As in RQ, the parent process sends heartbeats and forks a process for each attempt. That process ends when its parent
does, is asked to save its state before the worker stops, and is killed with all its children when its job is cancelled.

The parent must import neither torch nor pycolmap: their threads and locks do not survive a fork.
"""

import os
import select
import signal
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType
from typing import Any, Literal, TypeVar, cast
from uuid import uuid4

import redis
from redis.client import Pipeline
from rq import Queue, Worker
from rq.command import parse_payload
from rq.exceptions import NoSuchJobError, StopRequested
from rq.executions import Execution
from rq.job import Job, JobStatus
from rq.utils import now
from rq.worker.base import WorkerStatus
from rq.worker_registration import clean_worker_registry, register

from splatmill.backplane import keys, log_lines, totals
from splatmill.backplane.jobs.row import request_of
from splatmill.backplane.queue import entries, leases, lines, workers
from splatmill.backplane.queue.leases import Lease, Reclaim
from splatmill.backplane.queue.lines import Line
from splatmill.process import die_with_parent
from splatmill_worker.service import hand_back, recovery
from splatmill_worker.service.abandoned_folders import remove_abandoned, tidy
from splatmill_worker.service.attempt_limits import Exceeded, Limits, LimitWatch, RunTimeExceeded, die_first
from splatmill_worker.service.attempts.attempt import Attempt, start_attempt
from splatmill_worker.service.attempts.run_attempt import LoadPipeline, run_attempt
from splatmill_worker.service.disk_reserve import shortage_text, spare_bytes
from splatmill_worker.service.hand_back import HandedBack
from splatmill_worker.service.lock import JobLock, LockState
from splatmill_worker.service.process_exit import (
    HANDED_BACK_STATUS,
    UNREPORTED_STATUS,
    ProcessExit,
    oom_kill_count,
)
from splatmill_worker.service.saved_progress import SavedProgress
from splatmill_worker.service.units.run_tile import TileEntry, run_tile

STOP_GRACE = 50.0
"""Seconds that an attempt has to save its state, in storage too, when the worker is told to stop. Then it is killed,
and the next attempt resumes from the last checkpoint that was stored. docker-compose.yml grants ten seconds more, for
the return of the job to the queue."""

T = TypeVar("T")

AttemptEnd = Literal["reported", "stopped", "handed_back", "limited", "crashed", "superseded"]
"""How an attempt ended, as it is counted (`totals.ATTEMPTS`)."""

_RETRY_SECONDS = 0.5
_SPACE_SECONDS = 1.0  # between two checks of a disk that is full
_LOG_SECONDS = 30.0  # between two log lines about a Redis that does not work
_REMOVAL_INTERVAL = 300.0  # half as long as Redis knows that a job was deleted
_IDLE_SECONDS = 5.0


class AttemptEntry(entries.QueueEntry):
    """An entry of the queue that runs `run_attempt`, whatever function name and arguments it carries.

    RQ imports and calls the function that an entry names. Here the content of Redis does not decide which function
    runs, and entries of servers that know the function by another name still run.

    attempt: the attempt at the job, set in its process before it runs.
    load: returns the pipeline that the attempt runs, set with it.
    tile: the tile that is to be done instead.
    """

    attempt: Attempt | None = None
    load: LoadPipeline | None = None
    tile: TileEntry | None = None

    def func(self, *args: object, **kwargs: object) -> None:
        """Run the attempt. RQ calls this in place of the named function, with the entry's arguments."""
        if self.tile is not None:
            run_tile(self.tile)
            return
        assert self.attempt is not None
        assert self.load is not None
        run_attempt(self.attempt, self.load, can_retry=self.should_retry)


class AttemptWorker(Worker):
    """A worker that runs one attempt at a time.

    load: returns the pipeline that its attempts run.
    served: the lines that it takes entries from.
    stop_grace: seconds that an attempt has to save its state when the worker is told to stop.
    limits: how long an attempt may run, and how much memory it may use.
    """

    max_connection_wait_time = 2.0

    def __init__(
        self,
        connection: redis.Redis,
        load: LoadPipeline,
        served: Sequence[Line] = ("any", "cpu"),
        stop_grace: float = STOP_GRACE,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(
            [entries.open_queue(connection)],
            name=f"{os.uname().nodename}-{os.getpid()}-{uuid4().hex[:6]}",
            connection=connection,
            job_class=AttemptEntry,
            serializer=entries.SERIALIZER,
            worker_ttl=entries.WORKER_TTL,
            maintenance_interval=entries.MAINTENANCE_INTERVAL,
            job_monitoring_interval=entries.MONITORING_INTERVAL,
        )
        log_lines.bind(worker=self.name)
        self._load = load
        self._served = tuple(served)
        self._grace = stop_grace
        self._limits = limits or Limits()
        self._exceeded: Exceeded | None = None
        self._reclaim = Reclaim(connection)
        self._entry_id: str | None = None
        self._line: Line = "any"
        self._began = 0.0
        self._lock: JobLock | None = None
        self._saved: SavedProgress | None = None
        self._kill_at: float | None = None
        self._stop_reported = False
        self._wake: socket.socket | None = None
        self._wake_end: socket.socket | None = None
        self._superseded = False
        self._remove_at = 0.0

    # Start, maintenance and heartbeat. RQ ends a worker on most errors of Redis; here it waits.

    def check_for_suspension(self, burst: bool) -> None:
        self._until_redis_works(lambda: super(AttemptWorker, self).check_for_suspension(burst))

    def heartbeat(self, timeout: int | None = None, pipeline: Pipeline | None = None) -> None:
        """Keep the worker's record, and write it again if it has expired while Redis was away."""
        try:
            super().heartbeat(timeout or entries.WORKER_TTL, pipeline)
            if pipeline is None and not recovery.is_recorded(self):
                record: Any = self.serialize() | {"state": self.get_state()}
                self.connection.hset(self.key, mapping=record)
                register(self)
            elif pipeline is None:
                self.connection.hset(self.key, mapping=cast(Any, workers.spare(spare_bytes())))
        except redis.RedisError as error:
            self.log.warning("Worker %s: Redis took no heartbeat: %s", self.name, error)

    def _wait_for_space(self) -> None:
        """Take no job while the disk is full but for the reserve."""
        if (short := shortage_text()) is None:
            return
        self.log.error("Worker %s: takes no jobs: %s", self.name, short)
        self.set_state(WorkerStatus.SUSPENDED)
        while shortage_text():
            time.sleep(_SPACE_SECONDS)
            self._end_if_stopping()
            self.heartbeat()
        self.set_state(WorkerStatus.IDLE)
        self.log.info("Worker %s: takes jobs again", self.name)

    def set_shutdown_requested_date(self) -> None:
        try:
            super().set_shutdown_requested_date()  # type: ignore[no-untyped-call]  # RQ leaves it untyped
        except redis.RedisError as error:
            self.log.warning("Worker %s: stops, which Redis does not know: %s", self.name, error)

    def teardown(self) -> None:
        if self._stop_requested:
            self.log.info("Worker %s: stops on request", self.name)
        try:
            super().teardown()  # type: ignore[no-untyped-call]  # RQ leaves it untyped
        except redis.RedisError as error:
            # The record expires by itself.
            self.log.warning("Worker %s: its record stays in Redis: %s", self.name, error)
        signal.set_wakeup_fd(-1)
        for end in (self._wake, self._wake_end):
            if end is not None:
                end.close()

    def register_birth(self) -> None:
        super().register_birth()  # type: ignore[no-untyped-call]  # rq lacks types here and below
        recovery.requeue_orphans(self)

    def serialize(self) -> dict[str, Any]:
        """Return the worker's record: RQ's, with its process and the lines that it serves."""
        own = workers.served(self._served) | workers.spare(spare_bytes())
        return super().serialize() | recovery.process_fields() | own

    def run_maintenance_tasks(self) -> None:
        try:
            super().run_maintenance_tasks()  # type: ignore[no-untyped-call]  # RQ leaves it untyped
            if time.monotonic() >= self._remove_at:
                self._remove_at = time.monotonic() + _REMOVAL_INTERVAL
                for job_id in remove_abandoned(self.connection):
                    self.log.info(
                        "Worker %s: removed the folder of the job %s, which needs it no longer",
                        self.name,
                        job_id,
                    )
        except redis.RedisError as error:
            self.log.warning("Worker %s: maintenance is put off: %s", self.name, error)

    def clean_registries(self) -> None:
        """Requeue what lost workers held, and clean RQ's lists of finished entries and of workers.

        One worker cleans for all: to look at every worker's record, from every worker, is a hundred thousand commands a
        second where there are a thousand.
        """
        self._reclaim.run()
        if self.connection.set(keys.REGISTRIES_CHECKED, self.name, nx=True, ex=entries.MAINTENANCE_INTERVAL):
            queue = self.queues[0]
            queue.finished_job_registry.cleanup()
            queue.failed_job_registry.cleanup()
            clean_worker_registry(queue)
        self.last_cleaned_at = now()  # type: ignore[assignment]  # RQ types it as None

    def get_heartbeat_ttl(self, job: Job) -> int:
        return leases.LEASE

    @property
    def _lease(self) -> Lease:
        assert self.execution is not None
        return Lease(self.execution.job_id, self.execution.id)

    def _heartbeat(self, job: Job) -> None:
        """Send the heartbeats of an attempt; kill it if another attempt has taken its queue entry or its lock."""
        try:
            self.heartbeat()
            holds = leases.prolong(self.connection, self._lease) or self._rejoin(job)
            lock = self._lock.refresh() if self._lock else LockState.held
            if self._saved is not None and self._saved.advanced():
                leases.advanced(self.connection, job.id)
        except redis.RedisError as error:
            # The attempt can compute without Redis, and its outbox keeps the events.
            self.log.warning("Worker %s: Redis took no heartbeat: %s", self.name, error)
            return
        if lock is LockState.lost or not holds:
            self.log.warning(
                "Worker %s: another attempt at job %s has begun; killing this one", self.name, job.id
            )
            self._superseded = True
            self.kill_horse()

    def _rejoin(self, job: Job) -> bool:
        """Take the lease of the running attempt again if Redis has come back empty. Return whether it is held."""
        if not leases.rejoin(self.connection, self._lease, self.name, job.to_dict(include_meta=False)):
            return False
        self.log.warning(
            "Worker %s: Redis has lost its data; the attempt at job %s continues", self.name, job.id
        )
        return True

    # Stop requests

    def handle_payload(self, message: dict[str, Any]) -> None:
        payload = parse_payload(message)
        if payload["command"] != "stop-job":
            super().handle_payload(message)  # type: ignore[no-untyped-call]  # RQ leaves it untyped
        elif payload.get("job_id") == self._entry_id and self.horse_pid:
            # RQ compares with the current job in Redis, which is written later than the attempt begins.
            self._stopped_job_id = self._entry_id
            self.kill_horse()

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the attempt and every process that it started.

        The thread that hears commands calls this too, while the attempt may end: its process is 0 then, which would
        kill this process and its group. So it is read once.
        """
        if horse := self.horse_pid:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(horse, sig)

    # A signal handler can interrupt any line, with any lock held. So the handlers write neither to the log nor to
    # Redis, and raise nothing: redis-py drops exceptions in what it does around each command, and hiredis crashes on
    # one while it packs a number. They set fields, which each loop reads. Python writes to `_wake_end`, which ends a
    # wait.

    def _install_signal_handlers(self) -> None:
        self._wake, self._wake_end = socket.socketpair()
        self._wake_end.setblocking(False)
        signal.set_wakeup_fd(self._wake_end.fileno(), warn_on_full_buffer=False)
        super()._install_signal_handlers()  # type: ignore[no-untyped-call]  # RQ leaves it untyped

    def request_stop(self, signum: int, frame: FrameType | None) -> None:
        """Note that the worker shall stop, and ask the attempt to save its state."""
        self._shutdown_requested_date = now()
        signal.signal(signal.SIGINT, self.request_force_stop)
        signal.signal(signal.SIGTERM, self.request_force_stop)
        self._stop_requested = True
        self.handle_warm_shutdown_request()

    def handle_warm_shutdown_request(self) -> None:
        """Ask the attempt, if one runs, to save its state and end. It is killed at the end of the grace period."""
        if self.horse_pid:
            self._kill_at = time.monotonic() + self._grace
            with suppress(ProcessLookupError):
                os.kill(self.horse_pid, hand_back.SIGNAL)

    def request_force_stop(self, signum: int, frame: FrameType | None) -> None:
        """Kill the attempt on a second signal, without waiting for a checkpoint. The job is still handed back."""
        if self._shutdown_requested_date and (now() - self._shutdown_requested_date).total_seconds() < 1:
            return  # one Ctrl-C may arrive twice, from the terminal and from a supervisor
        self._kill_at = time.monotonic()
        self.kill_horse()

    def _end_if_stopping(self) -> None:
        """End a worker that holds no entry, if it was told to stop."""
        if self._stop_requested:
            raise StopRequested

    def _report_stop(self) -> None:
        """Log that the worker will stop after the running attempt, and note it in the worker's record, once."""
        if self._stop_requested and not self._stop_reported:
            self._stop_reported = True
            self.log.info("Worker %s: stops after the attempt at %s", self.name, self._entry_id)
            self.set_shutdown_requested_date()

    def unsubscribe(self) -> None:
        """Stop listening for commands. RQ would wait a second for the thread, which ends with this process anyway."""
        if self.pubsub_thread:
            self.pubsub_thread.stop()

    # One attempt

    def dequeue_job_and_maintain_ttl(
        self, timeout: int | None, max_idle_time: int | None = None
    ) -> tuple[Job, Queue] | None:
        """Wait for an entry and take it. Without a timeout (RQ's burst mode), return None if none waits."""
        job = self._until_redis_works(lambda: self._next(wait=timeout is not None))
        return (job, self.queues[0]) if job is not None else None

    def _next(self, *, wait: bool) -> Job | None:
        self._end_if_stopping()
        self.set_state(WorkerStatus.IDLE)
        while True:
            self.heartbeat()
            self._end_if_stopping()
            if self.should_run_maintenance_tasks:
                self.run_maintenance_tasks()
            self._wait_for_space()
            self._end_if_stopping()
            job = self._take()
            if job is not None or not wait:
                return job
            self._end_if_stopping()
            lines.wait(self.connection, self._served, _IDLE_SECONDS, self._wake)
            self._end_if_stopping()

    def _take(self) -> Job | None:
        taken = lines.take(self.connection, self.name, self._served)
        if taken is None:
            return None
        lease, self._line = taken
        self.execution = Execution(lease.execution, lease.entry, self.connection, self.name)
        self.set_state(WorkerStatus.BUSY)
        try:
            job = AttemptEntry.fetch(lease.entry, connection=self.connection, serializer=entries.SERIALIZER)
        except (ValueError, NoSuchJobError) as error:
            self.log.warning("Worker %s: the entry %s cannot be read: %s", self.name, lease.entry, error)
            leases.drop(self.connection, lease)
            self.execution = None
            self.set_state(WorkerStatus.IDLE)
            return None
        self.log.info("Worker %s: took %s from the line %s", self.name, lease.entry, self._line)
        return job

    def execute_job(self, job: Job, queue: Queue) -> None:
        self._entry_id, self._superseded, self._exceeded = job.id, False, None
        self._began = time.monotonic()
        self._bind_log(job)
        try:
            self.fork_work_horse(job, queue)
            self.monitor_work_horse(job, queue)
        finally:
            self._entry_id = None
        log_lines.bind(job=None, request=None)
        self._until_redis_works(lambda: self.set_state("idle"))

    def _bind_log(self, job: Job) -> None:
        """Name the job, and the request that asked for it, in all lines until the attempt has ended."""
        job_id, _ = entries.split_rq_id(job.id)
        log_lines.bind(
            job=job_id, request=self._until_redis_works(lambda: request_of(self.connection, job_id))
        )

    def fork_work_horse(self, job: Job, queue: Queue) -> None:
        job_id, _ = entries.split_rq_id(job.id)
        is_tile = entries.tile_of(job.id) is not None
        self._lock = None if is_tile else JobLock(self.connection, job_id, uuid4().hex)
        self._saved = None if is_tile else SavedProgress(job_id)
        parent = os.getpid()
        # Until the child has set up its own handlers, a signal would run those of the worker in the child.
        with hand_back.blocked_signals():
            child = os.fork()
            if child == 0:
                try:
                    os.setpgid(0, 0)
                    die_with_parent(parent)
                    die_first()
                    signal.set_wakeup_fd(-1)
                    hand_back.install_signal_handlers()
                    signal.pthread_sigmask(signal.SIG_UNBLOCK, hand_back.HANDLED)
                    self._run_child(job, queue)
                finally:
                    os._exit(1)
            with suppress(OSError):
                # Parent and child both set the group, so that a kill never reaches the worker's own group.
                os.setpgid(child, child)
            self._horse_pid = child
        if self._stop_requested:
            self.handle_warm_shutdown_request()

    def _run_child(self, job: Job, queue: Queue) -> None:
        """Run the attempt in the forked process, and exit with its status."""
        assert isinstance(job, AttemptEntry)
        try:
            if self._lock is None:
                job.tile = TileEntry(
                    self.connection, *entries.split_rq_id(job.id), entries.tile_of(job.id) or 0
                )
            else:
                job.load = self._load
                job.attempt = start_attempt(self.connection, job.id, self._lock.token)
                log_lines.bind(attempt=job.attempt.number)
                self.log.info("Worker %s: attempt %d at %s begins", self.name, job.attempt.number, job.id)
            self.main_work_horse(job, queue)
        except HandedBack:
            os._exit(HANDED_BACK_STATUS)
        except redis.RedisError as error:
            self.log.error("Worker %s: job %s does not begin: Redis: %s", self.name, job.id, error)
            os._exit(UNREPORTED_STATUS)

    def setup_work_horse_signals(self) -> None:
        """Do nothing: the handlers are set up before the attempt begins."""

    def monitor_work_horse(self, job: Job, queue: Queue) -> None:
        job.started_at = now()
        kills = oom_kill_count()
        horse = self.horse_pid
        status, usage = self._wait(job)
        process_exit = ProcessExit.of(status, usage, oom_kill_count() - kills)
        # No process that the attempt started may outlive it.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(horse, signal.SIGKILL)
        self._horse_pid = 0
        end = self._until_redis_works(lambda: self._settle(job, queue, process_exit))
        self._until_redis_works(lambda: tidy(self.connection, entries.split_rq_id(job.id)[0]))
        self._count(end, usage.ru_utime + usage.ru_stime)

    def _count(self, end: AttemptEnd, cpu_seconds: float) -> None:
        """Count an attempt that has ended. A Redis that fails now loses the count, which nothing depends on."""
        self.log.info("Worker %s: the attempt at %s has ended: %s", self.name, self._entry_id, end)
        counted = totals.counted(totals.ATTEMPTS, end) | totals.counted(totals.ATTEMPT_CPU, by=cpu_seconds)
        try:
            with self.connection.pipeline() as pipe:
                totals.add(pipe, counted)
                pipe.execute()
        except redis.RedisError as error:
            self.log.warning("Worker %s: the end of an attempt is not counted: %s", self.name, error)

    def _wait(self, job: Job) -> tuple[int, Any]:
        """Wait for the attempt's process, sending heartbeats.

        It is killed when it uses too much memory, and at the end of the grace period of a stop or of the longest run.

        Returns the wait status and the resource usage of the process.
        """
        handle = os.pidfd_open(self.horse_pid) if hasattr(os, "pidfd_open") else None
        beat_at = time.monotonic() + entries.MONITORING_INTERVAL
        watch, stop_at = LimitWatch(self._limits, self.horse_pid), float("inf")
        try:
            while True:
                pid, status, usage = os.wait4(self.horse_pid, os.WNOHANG)
                if pid:
                    return status, usage
                self._report_stop()
                if time.monotonic() >= beat_at:
                    beat_at = time.monotonic() + entries.MONITORING_INTERVAL
                    self._heartbeat(job)
                if self._exceeded is None and (exceeded := watch.exceeded()) is not None:
                    self._exceeded = exceeded
                    self.log.warning("Worker %s: %s", self.name, exceeded.problem().detail)
                    stop_at = time.monotonic()
                    if isinstance(exceeded, RunTimeExceeded):
                        stop_at += self._grace
                        with suppress(ProcessLookupError):
                            os.kill(self.horse_pid, hand_back.SIGNAL)
                if time.monotonic() >= min(stop_at, self._kill_at or stop_at):
                    self.kill_horse()
                if handle is not None:
                    select.select([handle], [], [], max(0.0, min(0.5, beat_at - time.monotonic())))
                else:
                    time.sleep(0.05)
        finally:
            if handle is not None:
                os.close(handle)

    def _settle(self, job: Job, queue: Queue, process_exit: ProcessExit) -> AttemptEnd:
        """Report how an attempt ended and update its queue entry, unless its process has done so itself.

        Return in a word how it ended.
        """
        if self._lock is None:
            return self._settle_tile(job, queue, process_exit)
        holder = self._lock.holder()
        ours = holder if holder and holder.token == self._lock.token else None
        ended = recovery.ended_attempt(self.connection, job.id, self._lock, ours)
        self._lock.release()
        if process_exit.clean:
            if self.connection.hget(job.key, "status") != JobStatus.FINISHED.value.encode():
                return "reported"  # a transient failure, which waits again
            lines.record_duration(self.connection, self._line, time.monotonic() - self._began)
            return "reported"
        if self._superseded or not Job.exists(job.id, self.connection):
            return "superseded"
        if process_exit.withdrawn:
            self._stopped_job_id = job.id
        if self._stopped_job_id == job.id:
            # The server reports `cancelled` once it reads this status: no process is left.
            self.handle_job_failure(job, queue, exc_string="Stopped on request.")
            return "stopped"
        if job.get_status() is not JobStatus.STARTED:
            return "reported"  # the process died after it had updated its entry
        if self._exceeded is not None:
            # Another attempt would come to the same limit.
            ended.report_failed(self._exceeded.problem())
            job.retries_left = 0
            self.handle_job_failure(job, queue, exc_string=self._exceeded.problem().detail)
            return "limited"
        if process_exit.handed_back or process_exit.unreported or self._stop_requested:
            why = "Redis took no events." if process_exit.unreported else "The worker is stopping."
            ended.report_requeued(f"{why} The job was put back in front of its owner's others.")
            recovery.hand_back(self, self._lease)
            return "handed_back"
        if job.should_retry:
            left = f"{job.retries_left} {'retry is' if job.retries_left == 1 else 'retries are'} left"
            ended.report_requeued(f"The job's process {process_exit.cause}. It is tried again: {left}.")
            if job.retries_left == entries.MAX_RETRIES:
                leases.to_the_front(self.connection, job.id)
            self.handle_job_failure(job, queue, exc_string=f"The process {process_exit.cause}.")
        else:
            ended.report_failed(process_exit.problem(attempts=entries.MAX_RETRIES + 1))
            self.handle_job_failure(job, queue, exc_string=f"The process {process_exit.cause}.")
        return "crashed"

    def _settle_tile(self, job: Job, queue: Queue, process_exit: ProcessExit) -> AttemptEnd:
        """Update the queue entry of a tile, unless its process has done so. The attempt that has the job reports."""
        if process_exit.clean:
            return "reported"
        if self._superseded or not Job.exists(job.id, self.connection):
            return "superseded"
        if job.get_status() is not JobStatus.STARTED:
            return "reported"
        if process_exit.withdrawn or self._exceeded is not None:
            job.retries_left = 0
        elif process_exit.handed_back or self._stop_requested:
            recovery.hand_back(self, self._lease)
            return "handed_back"
        self.handle_job_failure(job, queue, exc_string=f"The process {process_exit.cause}.")
        return "stopped" if process_exit.withdrawn else "crashed" if self._exceeded is None else "limited"

    def _until_redis_works(self, action: Callable[[], T]) -> T:
        """Return the result of `action`, which is repeated while Redis cannot be reached or refuses.

        There is no limit: nothing is computed meanwhile, and the log says what the worker waits for. A worker that
        holds no entry raises StopRequested once it is told to stop.
        """
        log_at = 0.0
        while True:
            try:
                return action()
            except redis.RedisError as error:
                if time.monotonic() >= log_at:
                    log_at = time.monotonic() + _LOG_SECONDS
                    self.log.warning("Worker %s: waiting for Redis: %s", self.name, error)
                if self.get_state() != WorkerStatus.BUSY:
                    self._end_if_stopping()
                time.sleep(_RETRY_SECONDS)

"""The queue worker: RQ's, with what it lacks for hours of native code.

RQ forks a process per attempt and keeps the heartbeat in the parent. Added here: that process dies with its
parent, is asked to save its state before the worker stops, is killed with all it started when its job is
cancelled, and is never one of two. Importing this must load neither torch nor pycolmap: their threads and
locks do not survive the fork.
"""

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any
from uuid import uuid4

import redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from rq import Queue, Worker
from rq.command import parse_payload
from rq.job import Job, JobStatus
from rq.utils import now

from splatmill.backplane import queue as backplane
from splatmill.backplane.process import die_with_parent
from splatmill_worker.service import attempt, recovery
from splatmill_worker.service.attempt import Attempt, HandedBack
from splatmill_worker.service.clean_up import sweep
from splatmill_worker.service.ending import Ending, oom_kills
from splatmill_worker.service.job import run_attempt
from splatmill_worker.service.lock import Held, JobLock

STOP_GRACE = 15.0
"""Seconds an attempt has to save its state when the worker is told to stop; then it is killed, and the next
attempt goes on from the checkpoint before."""

_GONE = (RedisConnectionError, RedisTimeoutError)
_RETRY_SECONDS = 0.5
_SWEEP_SECONDS = 3600.0


class AttemptEntry(backplane.QueueEntry):
    """An entry of the queue that runs `run_attempt`, whatever function name and arguments it carries.

    RQ imports and calls the function that an entry names. Here nothing that lies in Redis decides what runs, and
    entries of servers that know the attempt function by another name still run.
    """

    def func(self, *args: object, **kwargs: object) -> None:
        """Called by RQ in place of the named function, with the entry's arguments."""
        run_attempt()


class AttemptWorker(Worker):
    """A worker on one queue. `stop_grace` as STOP_GRACE, for tests and for operators in a hurry."""

    max_connection_wait_time = 2.0

    def __init__(
        self, connection: redis.Redis, queue: str = backplane.TRAIN, stop_grace: float = STOP_GRACE
    ) -> None:
        super().__init__(
            [backplane.open_queue(connection, queue)],
            name=f"{os.uname().nodename}-{os.getpid()}-{uuid4().hex[:6]}",
            connection=connection,
            job_class=AttemptEntry,
            serializer=backplane.SERIALIZER,
            worker_ttl=backplane.WORKER_TTL,
            maintenance_interval=backplane.MAINTENANCE_INTERVAL,
            job_monitoring_interval=backplane.MONITORING_INTERVAL,
        )
        self._grace = stop_grace
        self._running: str | None = None
        self._lock: JobLock | None = None
        self._kill_at: float | None = None
        self._given_away = False
        self._sweep_at = 0.0

    # Birth and heartbeat

    def register_birth(self) -> None:
        super().register_birth()  # type: ignore[no-untyped-call]  # rq's own gap, here and below
        recovery.sign(self)
        recovery.adopt(self)

    def run_maintenance_tasks(self) -> None:
        super().run_maintenance_tasks()  # type: ignore[no-untyped-call]
        if time.monotonic() >= self._sweep_at:
            self._sweep_at = time.monotonic() + _SWEEP_SECONDS
            for job_id in sweep(self.connection):
                self.log.info(
                    "Worker %s: removed the work folder of job %s, which is gone", self.name, job_id
                )

    def get_heartbeat_ttl(self, job: Job) -> int:
        return backplane.MONITORING_INTERVAL + backplane.HEARTBEAT_SLACK

    def _beat(self, job: Job) -> None:
        """Say that the attempt lives; end it when the queue or the lock was given to another meanwhile."""
        try:
            self.maintain_heartbeats(job)
            assert self.execution is not None
            registered = self.connection.zscore(job.started_job_registry.key, self.execution.composite_key)
            held = self._lock.refresh() if self._lock else Held.own
        except _GONE as error:
            # The attempt needs no Redis to compute; what it has to say waits in its outbox.
            self.log.warning("Worker %s: no heartbeat, Redis cannot be reached: %s", self.name, error)
            return
        if held is Held.lost or registered is None:
            self.log.warning("Worker %s: job %s was given to another attempt; ending ours", self.name, job.id)
            self._given_away = True
            self.kill_horse()

    # Stop requests

    def handle_payload(self, message: dict[str, Any]) -> None:
        payload = parse_payload(message)
        if payload["command"] != "stop-job":
            super().handle_payload(message)  # type: ignore[no-untyped-call]
        elif payload.get("job_id") == self._running and self.horse_pid:
            # RQ asks Redis whether this is the job at hand; the answer is known here, even before it is there.
            self._stopped_job_id = self._running
            self.kill_horse()

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the attempt with every process it started."""
        if self.horse_pid:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.horse_pid, sig)

    def handle_warm_shutdown_request(self) -> None:
        super().handle_warm_shutdown_request()  # type: ignore[no-untyped-call]
        if self.horse_pid:
            self._kill_at = time.monotonic() + self._grace
            with suppress(ProcessLookupError):
                os.kill(self.horse_pid, attempt.HAND_BACK_SIGNAL)

    def request_force_stop(self, signum: int, frame: FrameType | None) -> None:
        """A second signal: do not wait for the checkpoint. The job is handed back all the same."""
        if self._shutdown_requested_date and (now() - self._shutdown_requested_date).total_seconds() < 1:
            return  # a terminal and a supervisor may both pass on one Ctrl-C
        self._kill_at = time.monotonic()
        self.kill_horse()

    def unsubscribe(self) -> None:
        """RQ waits a second for its listening thread, which ends with this process anyway."""
        if self.pubsub_thread:
            self.pubsub_thread.stop()

    # One attempt

    def execute_job(self, job: Job, queue: Queue) -> None:
        self.prepare_execution(job)
        with self.connection.pipeline() as pipeline:
            # The registry holds the job from here on. Naming the worker now lets a stop request find it.
            job.prepare_for_execution(self.name, pipeline=pipeline)
            pipeline.lrem(queue.intermediate_queue_key, 1, job.id)
            pipeline.execute()
        self._running, self._given_away = job.id, False
        try:
            self.fork_work_horse(job, queue)
            self.monitor_work_horse(job, queue)
        finally:
            self._running = None
        self._insist(lambda: self.set_state("idle"))

    def fork_work_horse(self, job: Job, queue: Queue) -> None:
        job_id, _ = backplane.split_rq_id(job.id)
        self._lock = JobLock(self.connection, job_id, uuid4().hex)
        parent = os.getpid()
        signals = {signal.SIGTERM, signal.SIGINT, attempt.HAND_BACK_SIGNAL}
        # A signal between the fork and the child's own handlers would run the worker's in the child.
        signal.pthread_sigmask(signal.SIG_BLOCK, signals)
        child = os.fork()
        if child == 0:
            try:
                os.setpgid(0, 0)
                die_with_parent(parent)
                attempt.install_signal_handlers()
                signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
                self._attempt(job, queue)
            finally:
                os._exit(1)
        with suppress(OSError):
            # Both sides set it: whoever comes first, a kill never meets the worker's own group.
            os.setpgid(child, child)
        self._horse_pid = child
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
        if self._stop_requested:
            self.handle_warm_shutdown_request()

    def _attempt(self, job: Job, queue: Queue) -> None:
        """The child's life, from the lock to its exit status."""
        assert self._lock is not None
        try:
            attempt.begin(self.connection, job.id, self._lock.token)
            self.main_work_horse(job, queue)
        except HandedBack:
            os._exit(attempt.HANDED_BACK)

    def setup_work_horse_signals(self) -> None:
        """Already done before the attempt began."""

    def monitor_work_horse(self, job: Job, queue: Queue) -> None:
        job.started_at = now()
        kills = oom_kills()
        horse = self.horse_pid
        status, usage = self._wait(job)
        ending = Ending.of(status, usage, oom_kills() - kills)
        # Nothing the attempt started may go on without it.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(horse, signal.SIGKILL)
        self._horse_pid = 0
        self._insist(lambda: self._conclude(job, queue, ending))

    def _wait(self, job: Job) -> tuple[int, Any]:
        """Wait for the attempt's process to end, with heartbeats, and within the grace once told to stop."""
        handle = os.pidfd_open(self.horse_pid) if hasattr(os, "pidfd_open") else None
        beat_at = time.monotonic() + backplane.MONITORING_INTERVAL
        try:
            while True:
                pid, status, usage = os.wait4(self.horse_pid, os.WNOHANG)
                if pid:
                    return status, usage
                if time.monotonic() >= beat_at:
                    beat_at = time.monotonic() + backplane.MONITORING_INTERVAL
                    self._beat(job)
                if self._kill_at is not None and time.monotonic() >= self._kill_at:
                    self.kill_horse()
                if handle is not None:
                    select.select([handle], [], [], max(0.0, min(0.5, beat_at - time.monotonic())))
                else:
                    time.sleep(0.05)
        finally:
            if handle is not None:
                os.close(handle)

    def _conclude(self, job: Job, queue: Queue, ending: Ending) -> None:
        """Settle with the queue what the process could not settle itself."""
        assert self._lock is not None
        told = self._told(job)
        self._lock.release()
        if ending.clean or self._given_away or not Job.exists(job.id, self.connection):
            return
        if ending.withdrawn:
            self._stopped_job_id = job.id
        if self._stopped_job_id == job.id:
            # The server says `cancelled` once it reads this status: no process is left.
            self.handle_job_failure(job, queue, exc_string="Stopped on request.")
        elif job.get_status() is not JobStatus.STARTED:
            return  # it told the queue how it ended, and died after that
        elif ending.handed_back or self._stop_requested:
            attempt.requeued(told, "The worker is being stopped; the job goes back to the queue.")
            recovery.hand_back(self, job, queue)
        elif job.should_retry:
            tries = job.retries_left
            attempt.requeued(told, f"The job's process {ending.cause}; trying again ({tries} tries left).")
            self.handle_job_failure(job, queue, exc_string=f"The process {ending.cause}.")
        else:
            attempt.failed(told, ending.problem(attempts=backplane.MAX_RETRIES + 1))
            self.handle_job_failure(job, queue, exc_string=f"The process {ending.cause}.")

    def _told(self, job: Job) -> Attempt:
        """The attempt that just ended, to speak in its name."""
        assert self._lock is not None
        job_id, generation = backplane.split_rq_id(job.id)
        holder = self._lock.holder()
        number = holder.attempt if holder and holder.token == self._lock.token else 0
        return Attempt(
            self.connection, job_id, generation, number or recovery.attempts(self, job_id), self._lock
        )

    def _insist(self, action: Callable[[], None]) -> None:
        """Do what must be done, however long Redis stays away."""
        while True:
            try:
                action()
                return
            except _GONE as error:
                self.log.warning("Worker %s: waiting for Redis: %s", self.name, error)
                time.sleep(_RETRY_SECONDS)

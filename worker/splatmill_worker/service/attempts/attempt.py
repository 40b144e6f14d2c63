"""One attempt at one job, as both the attempt's process and its parent know it."""

import os
import time
from dataclasses import dataclass

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.queue.entries import split_rq_id
from splatmill.process import ProcessIdentity
from splatmill.schema import Event, JobState, LogEvent, Problem, StateEvent
from splatmill_worker.service import hand_back
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.redis_patience import patiently

_LOCK_POLL_SECONDS = 0.2

LONGEST_MESSAGE = 20_000
"""Largest number of characters of a log message; the rest is cut off."""


@dataclass(frozen=True)
class Attempt:
    """An attempt at a job.

    connection: the service's Redis.
    job_id: the job.
    generation: number of times that a client has started or restarted the job.
    number: number of the attempt, from 1 over all generations.
    lock: the job's lock, under the token of this attempt.
    """

    connection: redis.Redis
    job_id: str
    generation: int
    number: int
    lock: JobLock

    def report(self, event: Event) -> None:
        """Append an event to the job's streams under the number of this attempt."""
        events.append(self.connection, self.job_id, self.generation, self.number, event)

    def report_if_known(self, event: Event) -> bool:
        """Append an event if Redis still has the states of the job; it has not if it lost its data. Return whether."""
        return events.append_if_known(self.connection, self.job_id, self.generation, self.number, event)

    def rejoin(self) -> None:
        """Take the lock and the number of this attempt again, in a Redis that has lost both."""
        self.connection.set(keys.attempts(self.job_id), self.number, nx=True)
        self.lock.take(ProcessIdentity.of(os.getpid()), self.number)

    def report_requeued(self, reason: str) -> None:
        """Report that the attempt is over and that the job waits in the queue again."""
        self.report(LogEvent(level="warning", message=reason))
        self.report(StateEvent(state=JobState.queued))

    def report_failed(self, problem: Problem) -> None:
        """Report that the attempt is over and that the job failed."""
        self.report(LogEvent(level="error", message=problem.sentence[:LONGEST_MESSAGE]))
        self.report(StateEvent(state=JobState.failed, problem=problem))


def start_attempt(connection: redis.Redis, entry_id: str, token: str) -> Attempt:
    """Take the job's lock for this process, count a new attempt and return it.

    entry_id: id of the queue entry.
    token: the lock's token, which the parent process knows as well.

    Waits while another process holds the lock. This happens when a machine was suspended and the queue gave its job to
    another worker; the process on the suspended machine is killed at its next heartbeat.

    Raises HandedBack when the worker is stopped meanwhile, and redis.RedisError when Redis fails for longer than
    PATIENCE.
    """
    job_id, generation = split_rq_id(entry_id)
    lock = JobLock(connection, job_id, token)
    process = ProcessIdentity.of(os.getpid())
    while not patiently(lambda: lock.take(process, 0)):
        if hand_back.requested():
            raise hand_back.HandedBack
        time.sleep(_LOCK_POLL_SECONDS)
    number = patiently(lambda: events.begin_attempt(connection, job_id))
    patiently(lambda: lock.take(process, number))
    return Attempt(connection, job_id, generation, number, lock)

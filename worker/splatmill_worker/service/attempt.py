"""One attempt at one job, as both its process and its parent know it: what was asked for, its number, its lock.

`current` is set in the process of an attempt before the job begins, and nowhere else.
"""

import os
import signal
import time
from dataclasses import dataclass
from types import FrameType

import redis

from splatmill.backplane import events
from splatmill.backplane.process import ProcessIdentity
from splatmill.backplane.queue import split_rq_id
from splatmill.schema import Event, JobState, LogEvent, Problem, StateEvent
from splatmill_worker.service.lock import JobLock

HANDED_BACK = 75
"""Exit status (EX_TEMPFAIL) of an attempt that saved its state because the worker is being stopped."""

WITHDRAWN = 77
"""Exit status of an attempt that found, before it began, that its job is to be cancelled."""

HAND_BACK_SIGNAL = signal.SIGUSR1
"""What the worker asks an attempt to save its state by. Not SIGTERM: loading pycolmap replaces its handler by one
that prints a stack and dies."""

_LOCK_POLL = 0.2


class HandedBack(BaseException):
    """The worker is being stopped: the attempt ends here and the job goes back to the queue."""


@dataclass(frozen=True)
class Attempt:
    """Attempt `number` at `generation` of a job. `said` appends to the job's streams under that number."""

    connection: redis.Redis
    job_id: str
    generation: int
    number: int
    lock: JobLock

    def say(self, event: Event) -> None:
        events.append(self.connection, self.job_id, self.generation, self.number, event)


current: Attempt | None = None


def begin(connection: redis.Redis, rq_job_id: str, token: str) -> Attempt:
    """Wait for the job's lock, count the attempt, and make it this process's `current` one.

    The lock is free as a rule. It is held when the queue gave the job away while its process was only asleep
    (a laptop's lid); that process ends itself at its next heartbeat. Raises HandedBack when asked to stop.
    """
    global current
    job_id, generation = split_rq_id(rq_job_id)
    lock = JobLock(connection, job_id, token)
    process = ProcessIdentity.of(os.getpid())
    while not lock.take(process, 0):
        if hand_back_requested():
            raise HandedBack
        time.sleep(_LOCK_POLL)
    number = events.begin_attempt(connection, job_id)
    lock.take(process, number)
    current = Attempt(connection, job_id, generation, number, lock)
    return current


def requeued(attempt: Attempt, why: str) -> None:
    """Tell that an attempt is over and the job waits again."""
    attempt.say(LogEvent(level="warning", message=why))
    attempt.say(StateEvent(state=JobState.queued))


def failed(attempt: Attempt, problem: Problem) -> None:
    """Tell that the job failed, and why."""
    attempt.say(LogEvent(level="error", message=problem.sentence[:20_000]))
    attempt.say(StateEvent(state=JobState.failed, problem=problem))


# A signal handler may interrupt any line, so it takes no lock and only sets a flag.
_hand_back = False


def request_hand_back(signum: int, frame: FrameType | None) -> None:
    """The handler of HAND_BACK_SIGNAL in the process of an attempt."""
    global _hand_back
    _hand_back = True


def hand_back_requested() -> bool:
    """Whether the worker asked this attempt to save its state and end."""
    return _hand_back


def install_signal_handlers() -> None:
    """HAND_BACK_SIGNAL asks for a hand-back, SIGTERM kills; Ctrl-C in a terminal is the parent's to act on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(HAND_BACK_SIGNAL, request_hand_back)

"""The service as the faults reach it: which process is killed, when, and which job is spared."""

import random
import time
from collections import Counter
from contextlib import suppress
from functools import partial

from _soak.processes import SUPERVISOR, TRAINER, WORKER, Member
from _soak.proxy import Proxy
from _soak.service import Service, wait_for

MAX_TRAINER_KILLS = 2
"""Kills of the trainer of one job. A job whose process ends unexpectedly in four attempts is given up by design."""

MAX_WORKER_LOSSES = 4
"""Losses of the worker of one job. One that loses six in a row, without a new checkpoint, is given up by design."""

STARTED_BY_THE_SOAK = {SUPERVISOR}
"""Roles of processes that nothing in the service starts again; they have faults of their own, as Redis has."""

HOLD = (0.3, 4.0)
"""Seconds that a stop, a cut or a stall lasts: below and above the timeout of Redis with its retries."""

_RARE_SECONDS = 10.0  # for a process of the role that was killed least often, before others are considered
_VICTIM_SECONDS = 20.0  # for any process that may be killed
_SPARED_SECONDS = 60.0  # for a job that has lost its worker often enough to end
_MET_SECONDS = 10.0

_CHECKPOINT_SHARE = 1 / 3
"""Share of the kills of trainers and workers that wait until the attempt has stored a checkpoint."""

_CHECKPOINT_SECONDS = 8.0

_YOUNG_SHARE = 2 / 3
"""Share of the kills of what an attempt has started that come early in its life, when most of its work is done."""

_YOUNG_SECONDS = 4.0

_DELAY = (0.0, 4.0)  # seconds from such a process being found to its kill


class Target:
    """The service as the faults reach it.

    killed: kills by role.
    victim: the role of the newest kill of one process.
    struck: monotonic time at which the newest fault began.
    healed: monotonic time at which the newest fault was over: its kill, or the beginning of what takes it back.
    """

    def __init__(self, service: Service, rng: random.Random) -> None:
        self.service = service
        self.rng = rng
        self.killed: Counter[str] = Counter()
        self.victim: str | None = None
        self.struck = self.healed = 0.0
        self._trainers_killed: Counter[str] = Counter()
        self._workers_lost: Counter[str] = Counter()
        self._met_attempts: set[int] = set()
        self._young = False

    def strike(self) -> None:
        """Note that the fault begins now."""
        self.struck = time.monotonic()

    def lose_worker(self) -> None:
        """Count that the jobs that run may lose their worker, once none of them has lost it often."""

        def may() -> bool:
            return all(self._workers_lost[job] < MAX_WORKER_LOSSES for job in self.service.jobs_held())

        self.service.wait_for(may, _SPARED_SECONDS, "no job runs that has lost its worker often")
        self._workers_lost.update(self.service.jobs_held())

    def kill_one(self, role: str | None = None) -> None:
        """Kill a process that the service starts again by itself.

        role: its role; None: the one that was killed least often of those that have been met.
        """
        roles = [role] if role is not None else self._roles()
        self._young = self.rng.random() < _YOUNG_SHARE
        member = None
        with suppress(AssertionError):
            member = wait_for(partial(self._first, roles[:1]), _RARE_SECONDS, "the rarest role runs")
        if member is None:
            with suppress(AssertionError):
                find = partial(self._first, roles)
                member = self.service.wait_for(find, _VICTIM_SECONDS, "there is a process to kill")
        assert member is not None, f"There is no {role or 'process'} to kill; the processes are {roles}."
        self._count(member)
        self.victim = member.role
        self.killed[member.role] += 1
        self.struck = self.healed = time.monotonic()
        self.service.kill(member.pid)

    def _roles(self) -> list[str]:
        """Return the roles that the service starts again, those killed least often first."""
        roles = sorted(self.service.processes.roles - STARTED_BY_THE_SOAK)
        self.rng.shuffle(roles)
        return sorted(roles, key=self.killed.__getitem__)

    def _first(self, roles: list[str]) -> Member | None:
        return next((member for role in roles if (member := self._find(role)) is not None), None)

    def _find(self, role: str) -> Member | None:
        """Return a process of this role at a moment to kill it; None if there is none, or it is spared."""
        members = self.service.running(role)
        if not members:
            return None
        member = self.rng.choice(members)
        if not self._may(member):
            return None
        if TRAINER in member.line[:-1]:
            if self._young and member.age > _YOUNG_SECONDS * self.service.patience:
                return None
            time.sleep(self.rng.uniform(*_DELAY))
        elif role in (TRAINER, WORKER) and self.rng.random() < _CHECKPOINT_SHARE:
            begun = time.monotonic()
            with suppress(AssertionError):
                wait_for(lambda: self._has_stored(begun), _CHECKPOINT_SECONDS, "a checkpoint is stored")
        return member if member.runs and self._may(member) else None

    def _has_stored(self, since: float) -> bool:
        return any(line["what"] == "stored" for line in self.service.records() if line["at"] > since)

    def _may(self, member: Member) -> bool:
        """Whether no job fails by design if this process is killed.

        What an attempt has started is killed once in each attempt: a photo at which two decoders end is left out.
        """
        jobs = self.service.jobs_held()
        if TRAINER in member.line[:-1]:
            return not self._met_attempts & set(member.above)
        if member.role == TRAINER:
            return all(self._trainers_killed[job] < MAX_TRAINER_KILLS for job in jobs)
        return member.role != WORKER or all(self._workers_lost[job] < MAX_WORKER_LOSSES for job in jobs)

    def _count(self, member: Member) -> None:
        jobs = self.service.jobs_held()
        if TRAINER in member.line[:-1]:
            self._met_attempts |= set(member.above)
        elif member.role == TRAINER:
            self._trainers_killed.update(jobs)
        elif member.role == WORKER:
            self._workers_lost.update(jobs)

    def last(self, bounds: tuple[float, float]) -> None:
        """Let the fault last for some seconds, after which it is taken back."""
        time.sleep(self.rng.uniform(*bounds))
        self.healed = time.monotonic()

    def met(self, proxy: Proxy) -> None:
        """Let the fault of a proxy last for some seconds, and until it has met something."""
        self.last(HOLD)
        self.service.wait_for(lambda: proxy.met, _MET_SECONDS, "the fault has met a request")
        self.healed = time.monotonic()

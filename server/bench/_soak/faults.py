"""The kinds of fault: what each does to the service, at a moment of its own choice, and how it heals."""

import math
import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import psutil

from _soak.processes import TRAINER, WORKER
from _soak.proxy import Proxy
from _soak.service import Service
from _soak.target import HOLD, Target

KILLS = 200
"""Kills in a whole soak."""

_KILLED = " killed"
_ANY = "process killed"
"""Name of the kill of any process that the service starts again. Its row has the role of the process."""

_FROZEN = (18.0, 26.0)
"""Seconds that a worker is stopped, until its lease has expired and its job is in the queue, while its trainer runs on.
A lease lasts 15 s, and the reaper looks every 10."""

_AWAY = (0.0, 1.0)  # seconds before what was killed is started again


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    name: what the table calls it.
    weight: how often it comes in a round, beside others.
    kills: whether it ends processes.
    loses: whether the job that runs may lose its worker.
    act: does it to the service and heals it.
    needs: "s3", "folder", "disk" or "clock"; "" where every soak can have it.
    """

    name: str
    weight: int
    kills: bool
    act: Callable[[Target], None]
    needs: str = ""
    loses: bool = False


def _kill_role(role: str | None) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        target.kill_one(role)

    return act


def _kill_up(target: Target) -> None:
    target.strike()
    target.service.kill_up()
    target.last(_AWAY)
    target.service.start()


def _kill_all(target: Target) -> None:
    target.strike()
    target.service.kill_all()
    target.last(_AWAY)
    target.service.start_redis()
    target.service.start()


def _kill_redis(target: Target) -> None:
    target.strike()
    target.service.kill_redis()
    target.last(_AWAY)
    target.service.start_redis()


def _empty_redis(target: Target) -> None:
    target.strike()
    target.service.kill_redis(empty=True)
    target.last(_AWAY)
    target.service.start_redis()


def _stop(role: str, bounds: tuple[float, float] = HOLD) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        pid = target.service.redis_pid if role == "Redis" else target.service.part(role)
        target.strike()
        os.kill(pid, signal.SIGSTOP)
        target.last(bounds)
        if psutil.pid_exists(pid):
            os.kill(pid, signal.SIGCONT)

    return act


def _redis(what: str) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        spoil(target, target.service.redis_proxy, what)

    return act


def _s3(what: str) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        assert target.service.s3_proxy is not None
        spoil(target, target.service.s3_proxy, what)

    return act


def spoil(target: Target, proxy: Proxy, what: str) -> None:
    """Have a proxy cut off, stall or fail what passes it, and heal it whatever comes."""
    target.strike()
    try:
        getattr(proxy, what)()
        target.met(proxy)
    finally:
        proxy.heal()


def _full_disk(target: Target) -> None:
    target.strike()
    try:
        target.service.fill_disk()
        target.last(HOLD)
    finally:
        target.service.empty_disk()


def _jump(target: Target) -> None:
    """Forward by up to half an hour, or back to where the clock was, and the other way round."""
    clock = target.service.clock
    target.struck = target.healed = time.monotonic()
    clock.jump(-clock.offset if clock.offset else target.rng.choice((-1, 1)) * target.rng.randint(20, 1800))
    assert target.service.sees_clock(), "Redis does not follow the clock that was set."


FAULTS = (
    Fault(_ANY, 19, True, _kill_role(None)),
    Fault("Redis killed", 2, True, _kill_redis),
    Fault("Redis emptied", 1, True, _empty_redis),
    Fault("supervisor killed", 1, True, _kill_up, loses=True),
    Fault("everything killed", 2, True, _kill_all, loses=True),
    Fault("trainer stopped", 1, False, _stop(TRAINER)),
    Fault("worker stopped", 1, False, _stop(WORKER)),
    Fault("worker frozen", 1, False, _stop(WORKER, _FROZEN), loses=True),
    Fault("API stopped", 1, False, _stop("API")),
    Fault("renderer stopped", 1, False, _stop("renderer")),
    Fault("Redis stopped", 1, False, _stop("Redis")),
    Fault("Redis cut off", 1, False, _redis("cut")),
    Fault("Redis stalled", 1, False, _redis("stall")),
    Fault("disk full", 1, False, _full_disk, "disk"),
    Fault("clock set", 1, False, _jump, "clock", loses=True),
    Fault("S3 cut off", 1, False, _s3("cut"), "s3"),
    Fault("S3 stalled", 1, False, _s3("stall"), "s3"),
    Fault("S3 answers 503", 1, False, _s3("fail"), "s3"),
)
"""All kinds but the kills of one role, which _ANY stands for. A round holds each as often as its weight, in an order of
its own."""


def kill_of(role: str) -> Fault:
    """Return the kill of a process of a role."""
    return Fault(f"{role}{_KILLED}", 1, True, _kill_role(role))


def possible(service: Service) -> tuple[list[Fault], dict[str, str]]:
    """Return the faults that this soak can have, and why not for the others."""
    missing = {}
    if service.s3_proxy is None:
        missing["s3"] = "storage is a folder"
    if not service.disk:
        missing["disk"] = "no right to mount a small disk"
    if service.clock.missing is not None:
        missing["clock"] = service.clock.missing
    left_out = {fault.name: missing[fault.needs] for fault in FAULTS if fault.needs in missing}
    return [fault for fault in FAULTS if fault.name not in left_out], left_out


def enough(faults: Sequence[Fault]) -> int:
    """Return the number of faults in the fewest whole rounds with KILLS kills."""
    kills = sum(fault.weight for fault in faults if fault.kills)
    return math.ceil(KILLS / kills) * sum(fault.weight for fault in faults)


def schedule(
    faults: list[Fault], count: int, rng: random.Random, only: Sequence[str] | None = None
) -> list[Fault]:
    """Return so many faults, round after round; with `only`, one of each of these names.

    `only` may name the kill of any role.

    Raises ValueError for a name that no fault has.
    """
    if only is not None:
        names = {fault.name for fault in FAULTS}
        if unknown := {name for name in only if name not in names and not name.endswith(_KILLED)}:
            raise ValueError(
                f"There are no faults {sorted(unknown)}; the names are {sorted(names)}, and ROLE{_KILLED} for any role "
                "of a process."
            )
        chosen = [fault for fault in faults if fault.name in only]
        chosen += [kill_of(name.removesuffix(_KILLED)) for name in only if name not in names]
        rng.shuffle(chosen)
        return chosen
    plan: list[Fault] = []
    while len(plan) < count:
        deck = [fault for fault in faults for _ in range(fault.weight)]
        rng.shuffle(deck)
        plan += deck
    return plan[:count]

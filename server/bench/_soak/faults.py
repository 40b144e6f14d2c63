"""The kinds of fault: what each does to the service, at a moment of its own choice, and how it heals."""

import math
import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import psutil

from _soak.proxy import Proxy
from _soak.service import Service, wait_for

KILLS = 200
"""Kills in a whole soak."""

MAX_TRAINER_KILLS = 2
"""Kills of the trainer of one job. A job whose process ends unexpectedly in four attempts is given up by design."""

_HOLD = (0.3, 4.0)
"""Seconds that a stop, a cut or a stall lasts: below and above the timeout of Redis with its retries."""

_FROZEN = (18.0, 26.0)
"""Seconds that a worker is stopped, until its lease has expired and its job is in the queue, while its trainer runs on.
A lease lasts 15 s, and the reaper looks every 10."""

_AWAY = (0.0, 1.0)  # seconds before what was killed is started again
_TARGET_SECONDS = 20.0
_MET_SECONDS = 10.0


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    name: what the table calls it.
    weight: how often it comes in a round, beside others.
    kills: whether it ends processes.
    act: does it to the service and heals it.
    needs: "s3", "folder", "disk" or "clock"; "" where every soak can have it.
    """

    name: str
    weight: int
    kills: bool
    act: Callable[["Target"], None]
    needs: str = ""


class Target:
    """The service as the faults reach it.

    killed: kills of trainers by job.
    struck: monotonic time at which the newest fault began.
    healed: monotonic time at which the newest fault was over: its kill, or the beginning of what takes it back.
    """

    def __init__(self, service: Service, rng: random.Random) -> None:
        self.service = service
        self.rng = rng
        self.killed: dict[str, int] = {}
        self.struck = self.healed = 0.0

    def strike(self) -> None:
        """Note that the fault begins now."""
        self.struck = time.monotonic()

    def trainer(self, *, spare: bool = False) -> int:
        """Return the process of the attempt that runs. With `spare`, not of a job whose trainers were killed often."""

        def find() -> int | None:
            ended = set()
            for line in reversed(self.service.records()):
                if line["what"] == "end":
                    ended.add(line["pid"])
                elif line["what"] == "begin" and line["pid"] not in ended:
                    if not psutil.pid_exists(line["pid"]):
                        return None
                    if spare and self.killed.get(line["job"], 0) >= MAX_TRAINER_KILLS:
                        return None
                    self.killed[line["job"]] = self.killed.get(line["job"], 0) + spare
                    return int(line["pid"])
                elif line["what"] == "begin":
                    return None
            return None

        return int(wait_for(find, _TARGET_SECONDS, "an attempt runs"))

    def last(self, bounds: tuple[float, float]) -> None:
        """Let the fault last for some seconds, after which it is taken back."""
        time.sleep(self.rng.uniform(*bounds))
        self.healed = time.monotonic()

    def met(self, proxy: Proxy) -> None:
        """Let the fault of a proxy last for some seconds, and until it has met something."""
        self.last(_HOLD)
        wait_for(lambda: proxy.met, _MET_SECONDS, "the fault has met a request")
        self.healed = time.monotonic()

    def kill(self, pid: int) -> None:
        """Kill a process that the service starts again by itself."""
        self.struck = self.healed = time.monotonic()
        self.service.kill(pid)


def _kill_trainer(target: Target) -> None:
    target.kill(target.trainer(spare=True))


def _kill_part(name: str) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        target.kill(target.service.part(name))

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


def _stop(find: Callable[[Target], int], bounds: tuple[float, float] = _HOLD) -> Callable[[Target], None]:
    def act(target: Target) -> None:
        pid = find(target)
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
        target.last(_HOLD)
    finally:
        target.service.empty_disk()


def _jump(target: Target) -> None:
    """Forward by up to half an hour, or back to where the clock was, and the other way round."""
    clock = target.service.clock
    target.struck = target.healed = time.monotonic()
    clock.jump(-clock.offset if clock.offset else target.rng.choice((-1, 1)) * target.rng.randint(20, 1800))
    assert target.service.sees_clock(), "Redis does not follow the clock that was set."


FAULTS = (
    Fault("trainer killed", 4, True, _kill_trainer),
    Fault("worker killed", 4, True, _kill_part("worker")),
    Fault("API killed", 3, True, _kill_part("api")),
    Fault("renderer killed", 2, True, _kill_part("renderer")),
    Fault("Redis killed", 3, True, _kill_redis),
    Fault("supervisor killed", 1, True, _kill_up),
    Fault("everything killed", 2, True, _kill_all),
    Fault("Redis emptied", 1, True, _empty_redis),
    Fault("trainer stopped", 1, False, _stop(Target.trainer)),
    Fault("worker stopped", 1, False, _stop(lambda target: target.service.part("worker"))),
    Fault("worker frozen", 1, False, _stop(lambda target: target.service.part("worker"), _FROZEN)),
    Fault("API stopped", 1, False, _stop(lambda target: target.service.part("api"))),
    Fault("renderer stopped", 1, False, _stop(lambda target: target.service.part("renderer"))),
    Fault("Redis stopped", 1, False, _stop(lambda target: target.service.redis_pid)),
    Fault("Redis cut off", 1, False, _redis("cut")),
    Fault("Redis stalled", 1, False, _redis("stall")),
    Fault("disk full", 1, False, _full_disk, "disk"),
    Fault("clock set", 1, False, _jump, "clock"),
    Fault("S3 cut off", 1, False, _s3("cut"), "s3"),
    Fault("S3 stalled", 1, False, _s3("stall"), "s3"),
    Fault("S3 answers 503", 1, False, _s3("fail"), "s3"),
)
"""All kinds. A round holds each as often as its weight, in an order of its own."""


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

    Raises ValueError for a name that no fault has.
    """
    if only is not None:
        if unknown := set(only) - {fault.name for fault in FAULTS}:
            raise ValueError(
                f"There are no faults {sorted(unknown)}; the names are {[f.name for f in FAULTS]}."
            )
        chosen = [fault for fault in faults if fault.name in only]
        rng.shuffle(chosen)
        return chosen
    found: list[Fault] = []
    while len(found) < count:
        deck = [fault for fault in faults for _ in range(fault.weight)]
        rng.shuffle(deck)
        found += deck
    return found[:count]

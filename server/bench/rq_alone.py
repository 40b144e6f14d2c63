"""What RQ does by its public interface alone where the queue of Splatmill has code of its own.

    splatmill bench rq_alone                     # six minutes, hardly any of it on the processors
    splatmill bench rq_alone --only killed frozen

A queue for each owner, RQ's round-robin worker, retries, `at_front` and RQ's own heartbeats, intermediate queue and
registries, with the intervals that Splatmill uses, against a Redis of its own. Each case is a fault or a need of the
service (`soak.md` has what the service does in the same place), in processes of their own, killed or stopped for real.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import redis
from _page import table
from _private_redis import running
from _rows import Row, footer
from _rq_worker import HEARTBEAT, PAUSE
from _studies.study import Study
from rq import Queue, Retry
from rq.job import Job
from rq.serializers import JSONSerializer

HERE = Path(__file__).resolve().parent

PATIENCE = 150.0
"""Seconds for which a case waits for what may never come."""


@dataclass
class Trial:
    """A Redis with workers on it, and the file that their entries write to.

    address: of the Redis.
    folder: of all files of the trial.
    started: the workers, by process.
    """

    address: str
    folder: Path
    started: list[subprocess.Popen[bytes]]

    @property
    def connection(self) -> redis.Redis:
        return redis.Redis.from_url(self.address)

    def worker(self, *queues: str, kind: str = "plain") -> subprocess.Popen[bytes]:
        """Start a worker in a group of its own; its attempts have theirs."""
        command = [sys.executable, str(HERE / "_rq_worker.py"), self.address, kind, *queues]
        environment = os.environ | {"PYTHONPATH": str(HERE)}
        self.started.append(subprocess.Popen(command, env=environment, start_new_session=True))
        return self.started[-1]

    def enqueue(self, queue: str, name: str, seconds: float) -> Job:
        """Enqueue work of some seconds whose lines go to the file `name`."""
        where = Queue(queue, connection=self.connection, serializer=JSONSerializer)
        arguments = [str(self.folder / name), seconds]
        return where.enqueue_call("_rq_worker.work", args=arguments, timeout=-1, retry=Retry(max=3))

    def lines(self, name: str) -> list[tuple[int, float, str]]:
        """Process, time and word of each line that work has written."""
        path = self.folder / name
        rows = [line.split() for line in path.read_text().splitlines()] if path.exists() else []
        return [(int(row[0]), float(row[1]), row[2]) for row in rows if len(row) == 3]

    def begun(self, name: str) -> dict[int, float]:
        """When each process that did the work wrote its first line."""
        first: dict[int, float] = {}
        for process, at, _ in self.lines(name):
            first.setdefault(process, at)
        return first

    def ended(self, name: str) -> int:
        """How often the work was done to its end."""
        return sum(word == "end" for _, _, word in self.lines(name))


@contextmanager
def trial() -> Iterator[Trial]:
    with tempfile.TemporaryDirectory(prefix="splatmill-rq-") as name, running(Path(name)) as address:
        made = Trial(address, Path(name), [])
        try:
            yield made
        finally:
            for worker in made.started:
                if worker.poll() is None:
                    for process in _family(worker.pid):
                        os.kill(process, signal.SIGKILL)
                    worker.wait(30)


def late_owner(_: argparse.Namespace) -> Iterator[Row]:
    """An owner whose first job comes while a worker runs."""
    with trial() as made:
        made.worker("any-ann", "any-bob")
        made.enqueue("any-ann", "ann", 0.5)
        _until(lambda: made.ended("ann") == 1)
        made.enqueue("any-cy", "cy", 0.5)
        waited = _until(lambda: made.ended("cy") == 1, 60)
    yield _row("late_owner", waited, "not begun in {limit:.0f} s", "begun after {seconds:.0f} s", limit=60)


def taken(_: argparse.Namespace) -> Iterator[Row]:
    """A worker of several queues that is killed between the taking of an entry and its beginning."""
    with trial() as made:
        dying = made.worker("any-ann", "any-bob", kind="dies")
        job = made.enqueue("any-ann", "ann", 0.5)
        dying.wait(30)
        made.worker("any-ann", "any-bob")
        waited = _until(lambda: made.ended("ann") == 1)
        state = Job.fetch(job.id, made.connection, JSONSerializer).get_status().value
    yield _row(
        "taken",
        waited,
        f"lost: not begun in {{limit:.0f}} s, and called {state} for ever",
        "begun after {seconds:.0f} s",
    )


def taken_of_one(_: argparse.Namespace) -> Iterator[Row]:
    """The same with a single queue, where RQ has its intermediate queue."""
    with trial() as made:
        dying = made.worker("any", kind="dies")
        made.enqueue("any", "ann", 0.5)
        dying.wait(30)
        made.worker("any")
        waited = _until(lambda: made.ended("ann") == 1)
    yield _row(
        "taken_of_one", waited, "not begun again in {limit:.0f} s", "begun again after {seconds:.0f} s"
    )


def killed(_: argparse.Namespace) -> Iterator[Row]:
    """A machine that is lost while it works: worker and attempt are killed."""
    with trial() as made:
        lost = made.worker("any-ann", "any-bob")
        made.enqueue("any-ann", "ann", 300)
        _until(lambda: bool(made.begun("ann")))
        time.sleep(HEARTBEAT + 1)
        for process in _family(lost.pid):
            os.kill(process, signal.SIGKILL)
        made.worker("any-ann", "any-bob")
        waited = _until(lambda: len(made.begun("ann")) == 2)
    yield _row("killed", waited, "not begun again in {limit:.0f} s", "begun again after {seconds:.0f} s")


def frozen(_: argparse.Namespace) -> Iterator[Row]:
    """A machine that sleeps until another has its work, and wakes."""
    with trial() as made:
        sleeping = made.worker("any-ann", "any-bob")
        made.enqueue("any-ann", "ann", 40)
        _until(lambda: bool(made.begun("ann")))
        for process in (family := _family(sleeping.pid)):
            os.kill(process, signal.SIGSTOP)
        made.worker("any-ann", "any-bob")
        _until(lambda: len(made.begun("ann")) == 2)
        for process in family:
            os.kill(process, signal.SIGCONT)
        time.sleep(60)
        yield _both("frozen", made)


def clock(_: argparse.Namespace) -> Iterator[Row]:
    """A machine whose clock is 90 s ahead, which looks for entries of lost workers."""
    with trial() as made:
        made.worker("any-ann", "any-bob")
        job = made.enqueue("any-ann", "ann", 40)
        _until(lambda: bool(made.begun("ann")))
        made.worker("any-ann", "any-bob")
        time.sleep(5)
        queue = Queue(job.origin, connection=made.connection, serializer=JSONSerializer)
        queue.started_job_registry.cleanup(timestamp=time.time() + 90)
        time.sleep(60)
        yield _both("clock", made)


def redis_away(_: argparse.Namespace) -> Iterator[Row]:
    """A Redis that does not answer for 40 s, while a worker works."""
    with trial() as made:
        worker = made.worker("any-ann", "any-bob")
        made.enqueue("any-ann", "ann", 70)
        _until(lambda: bool(made.begun("ann")))
        process = int(made.connection.info("server")["process_id"])
        os.kill(process, signal.SIGSTOP)
        time.sleep(40)
        os.kill(process, signal.SIGCONT)
        waited = _until(lambda: made.ended("ann") >= 1)
        time.sleep(20)
        alive = worker.poll() is None
        again = len(made.begun("ann")) - 1
    became = f"the worker {'lives' if alive else 'has ended'}; begun again {again} times"
    yield _row("redis_away", waited, became, became)


def _both(case: str, made: Trial) -> Row:
    """A row that says for how long two processes did the same work, and how often it was done."""
    first, *others = made.begun("ann")
    since = min((made.begun("ann")[process] for process in others), default=math.inf)
    both = PAUSE * sum(process == first and at >= since for process, at, _ in made.lines("ann"))
    text = f"two processes did the same work for {both:.0f} s; it was done {made.ended('ann')} times"
    return {
        "bench": "rq_alone",
        "case": case,
        "rq": metadata.version("rq"),
        "seconds": round(both, 1),
        "became": text,
    }


def _row(case: str, waited: float | None, never: str, then: str, limit: float = PATIENCE) -> Row:
    text = never.format(limit=limit) if waited is None else then.format(seconds=waited)
    seconds = None if waited is None else round(waited, 1)
    return {
        "bench": "rq_alone",
        "case": case,
        "rq": metadata.version("rq"),
        "seconds": seconds,
        "became": text,
    }


def _until(holds: Callable[[], bool], limit: float = PATIENCE) -> float | None:
    """Seconds until this holds; None where it does not in time."""
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < limit:
        if holds():
            return passed
        time.sleep(0.1)
    return None


def _family(process: int) -> list[int]:
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [process, *(grandchild for child in children for grandchild in _family(int(child)))]


NEEDS = {
    "late_owner": "an owner who comes later is served",
    "taken": "an entry is never lost, with a queue for each owner",
    "taken_of_one": "an entry whose worker dies as it takes it comes back",
    "killed": "work of a lost machine continues elsewhere",
    "frozen": "nothing runs twice: a machine that slept",
    "clock": "nothing runs twice: clocks that differ",
    "redis_away": "a worker outlives a Redis that is away",
}
"""What the service needs in each case."""

CASES = dict(zip(NEEDS, (late_owner, taken, taken_of_one, killed, frozen, clock, redis_away), strict=True))


def cases(rows: list[Row]) -> str:
    """What became of each case."""
    told = {row["case"]: row["became"] for row in rows}
    lines = [
        [(CASES[case].__doc__ or "").rstrip("."), NEEDS[case], told[case]] for case in CASES if case in told
    ]
    return table("case|needed|RQ alone", lines)


STUDY = Study(
    name="rq_alone",
    about=__doc__,
    cases=CASES,
    key=("bench", "case"),
    home=HERE,
    parts=("server", "client"),
    blocks={"cases": cases, "footer": lambda rows: f"RQ {rows[-1]['rq']} · {footer(rows)}"},
    figures={},
    order=lambda row: list(CASES).index(row["case"]),
)
main = STUDY.main

"""Proves that a soak finds every process of the service by its descent, and kills each role as often as the others.

The processes are real ones, started here. Not proven here: which processes the service has
(tests/service/test_soak.py).
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from _soak import service as soaked
from _soak import target, verdict
from _soak.orphans import Adoption
from _soak.processes import Member, Processes, role_of
from _soak.target import Target

from splatmill.process import start_time
from tests.support.waiting import wait_for

PYTHON = "/usr/bin/python3.11"
UP = [PYTHON, "-m", "splatmill_server.up", "--data", "x"]
TRAIN = [PYTHON, "-m", "splatmill_worker", "train", "--stop-grace", "15"]


@pytest.mark.parametrize(
    ("command", "parent_command", "parent", "role"),
    [
        (UP, [], None, "supervisor"),
        ([PYTHON, "-m", "splatmill_server.up.api", "5"], UP, "supervisor", "API"),
        (TRAIN, UP, "supervisor", "worker"),
        (TRAIN, TRAIN, "worker", "trainer"),
        ([PYTHON, "-I", "-m", "splatmill_worker.images.decoding.decoder"], TRAIN, "trainer", "decoder"),
        ([PYTHON, "-m", "splatmill_worker", "renderer", "--uds", "x"], UP, "supervisor", "renderer"),
        # What no list has is called by its own name.
        ([PYTHON, "-m", "some.module", "--flag"], TRAIN, "trainer", "some.module"),
        ([PYTHON, "/a/script.py"], TRAIN, "trainer", "script.py"),
        ([PYTHON, "-c", "pass"], TRAIN, "worker", "python -c"),
        (["/usr/bin/ffmpeg", "-i", "x"], TRAIN, "trainer", "ffmpeg"),
        (
            [PYTHON, "-m", "some.module"],
            [PYTHON, "-m", "some.module"],
            "some.module",
            "fork of the some.module",
        ),
    ],
)
def test_a_process_is_named_by_its_command_line(
    command: list[str], parent_command: list[str], parent: str | None, role: str
) -> None:
    assert role_of(command, parent_command, parent) == role


def test_what_a_part_has_started_is_named_with_that_part() -> None:
    def role(*line: str) -> str:
        return Member(1, "1", line).role

    assert role("supervisor") == "supervisor"
    assert role("supervisor", "worker") == "worker"
    assert role("supervisor", "worker", "trainer") == "trainer"
    assert role("supervisor", "worker", "trainer", "decoder") == "decoder of the trainer"
    assert role("supervisor", "renderer", "decoder") == "decoder of the renderer"


@pytest.fixture
def adoption() -> Iterator[Adoption]:
    parent = Adoption()
    if parent.missing is not None:
        pytest.skip(parent.missing)
    yield parent
    parent.end()


def test_every_process_below_is_found_and_keeps_its_role_without_a_parent(adoption: Adoption) -> None:
    program = "import subprocess, time; subprocess.Popen(['sleep', '600']); time.sleep(600)"
    processes = Processes(lambda: adoption.own, top="python -c")
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        try:
            wait_for(lambda: "sleep of the python -c" in {one.role for one in processes.look()})
            (child,) = [one for one in processes.look() if parent.pid in one.above]
            parent.kill()
            parent.wait(20)
            wait_for(lambda: adoption.orphans([parent.pid]) == [child.pid])
            assert processes.look() == [child]
            assert processes.roles == {"python -c", "sleep of the python -c"}
            assert child.runs
        finally:
            parent.kill()
            for one in processes.members:
                if one.runs:
                    os.kill(one.pid, signal.SIGKILL)
    wait_for(lambda: not any(one.runs for one in processes.members))
    wait_for(lambda: adoption.orphans([]) == [])


class Fake:
    """A service of processes that sleep, in the place of `Service`."""

    def __init__(self, *lines: tuple[str, ...]) -> None:
        self.jobs = {"a"}
        self.patience = 100.0
        self.children = [subprocess.Popen(["sleep", "600"]) for _ in lines]
        pids = [child.pid for child in self.children]
        self.members = [
            Member(pid, start_time(pid) or "", line, tuple(pids[:number]))
            for number, (pid, line) in enumerate(zip(pids, lines, strict=True))
        ]
        self.processes = SimpleNamespace(roles={member.role for member in self.members})
        self.killed: list[int] = []

    def running(self, role: str) -> list[Member]:
        return [member for member in self.members if member.role == role]

    def jobs_held(self) -> set[str]:
        return self.jobs

    def records(self) -> list[dict[str, Any]]:
        return [{"what": "stored", "at": time.monotonic() + 60}]

    def wait_for(self, condition: Any, seconds: float, what: str) -> Any:
        return soaked.wait_for(condition, seconds, what)

    def kill(self, *pids: int) -> None:
        self.killed += pids

    def close(self) -> None:
        for child in self.children:
            child.kill()
            child.wait(20)


WORKER = ("supervisor", "worker")
TRAINER = (*WORKER, "trainer")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[Fake]:
    monkeypatch.setattr(target, "_RARE_SECONDS", 0.0)
    monkeypatch.setattr(target, "_VICTIM_SECONDS", 0.0)
    monkeypatch.setattr(target, "_DELAY", (0.0, 0.0))
    service = Fake(("supervisor",), WORKER, TRAINER, (*TRAINER, "decoder"), ("supervisor", "API"))
    yield service
    service.close()


def test_each_role_is_killed_as_often_as_the_others_and_spared_by_rule(fake: Fake) -> None:
    reached = Target(cast(Any, fake), random.Random(0))
    for _ in range(4):
        reached.kill_one()
    assert reached.killed == {"worker": 1, "trainer": 1, "decoder of the trainer": 1, "API": 1}
    for _ in range(20):
        reached.kill_one()
    # One decoder of an attempt, two trainers and four workers of a job; the supervisor is started by the soak.
    assert reached.killed["decoder of the trainer"] == 1
    assert reached.killed["trainer"] == target.MAX_TRAINER_KILLS
    assert reached.killed["worker"] == target.MAX_WORKER_LOSSES
    assert reached.killed["API"] == 24 - 1 - target.MAX_TRAINER_KILLS - target.MAX_WORKER_LOSSES
    assert "supervisor" not in reached.killed
    fake.jobs = {"b"}
    reached.kill_one("trainer")
    assert reached.victim == "trainer"


def test_a_role_that_does_not_run_is_told(fake: Fake) -> None:
    with pytest.raises(AssertionError, match="There is no renderer to kill"):
        Target(cast(Any, fake), random.Random(0)).kill_one("renderer")


def test_a_role_that_was_met_and_never_killed_is_told(fake: Fake) -> None:
    reached = Target(cast(Any, fake), random.Random(0))
    for role in ("worker", "trainer", "API"):
        reached.kill_one(role)
    cast(Any, fake).records = lambda: [{"what": "resume", "step": 5}]
    assert verdict.met(cast(Any, fake), reached) == [
        "a process was met and never killed: the decoder of the trainer"
    ]
    reached.kill_one("decoder of the trainer")
    assert verdict.met(cast(Any, fake), reached) == []
    cast(Any, fake).records = lambda: [{"what": "resume", "step": 0}]
    assert verdict.met(cast(Any, fake), reached) == ["no attempt trained on from a checkpoint"]

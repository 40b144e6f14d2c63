"""Captures, jobs and models as the service leaves them, as many as are asked for, without running any.

Every record lies in storage as its writer stores it: `capture.json`, the log of an ended job, the request of a queued
one, and the files of a model. Redis knows nothing of them: it is filled as one that has come back empty.
"""

import json
import random
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from _one_gaussian import ply

from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Job, JobState, Problem, Progress, TrainOptions

FIRST = datetime(2026, 1, 1, tzinfo=UTC)
"""Time of the oldest record; each later one is a second younger."""

QUEUED, FAILED = 0.01, 0.1
"""Shares of the jobs that wait and that have failed; the others have a model."""

OWNERS = 20

_PLAN = {f"decision_{number}": {"value": number, "reason": "x" * 40} for number in range(30)}
"""About 2 kB, as the plan of a training."""


@dataclass(frozen=True)
class Seeded:
    """What was stored: ids of captures, jobs by state, and models."""

    captures: list[str]
    queued: list[str]
    failed: list[str]
    succeeded: list[str]

    @property
    def jobs(self) -> int:
        """Number of jobs."""
        return len(self.queued) + len(self.failed) + len(self.succeeded)


def seed(storage: Storage, count: int, chance: int = 0) -> Seeded:
    """Store `count` captures, a job on each, and the models of the jobs that have succeeded.

    chance: seed of the random choice of states.
    """
    choice = random.Random(chance)
    ids = [f"{number:016x}" for number in range(count)]
    states = ["queued", "failed"] + ["succeeded"] * (count - 2)
    for number in range(2, count):
        drawn = choice.random()
        states[number] = "queued" if drawn < QUEUED else "failed" if drawn < QUEUED + FAILED else "succeeded"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: _store(storage, number, ids[number], states[number]), range(count)))
    return Seeded(ids, *(_of(ids, states, state) for state in ("queued", "failed", "succeeded")))


def _of(ids: Sequence[str], states: Sequence[str], state: str) -> list[str]:
    return [name for name, current in zip(ids, states, strict=True) if current == state]


def _store(storage: Storage, number: int, name: str, state: str) -> None:
    created = FIRST + timedelta(seconds=number)
    owner = f"owner{number % OWNERS}"
    capture = {"id": name, "name": f"scene {number}", "owner": owner, "created_at": created.isoformat()}
    storage.put(layout.capture_record(name), json.dumps(capture | {"format": FORMAT}).encode())
    named = {"id": name, "capture": name, "name": f"job {number}", "owner": owner, "created_at": created}
    if state == "queued":
        row = JobRow(**named, options=TrainOptions(), queued_at=created)  # type: ignore[arg-type]  # typed by name
        storage.put(layout.unfinished_job(name), row.model_dump_json(exclude_none=True).encode())
        return
    job = Job(
        **named,  # type: ignore[arg-type]  # typed by name
        state=JobState(state),
        options=TrainOptions(),
        started_at=created,
        finished_at=created + timedelta(seconds=60),
        attempt=1,
        progress=Progress(stage="training", done=3000, total=3000),
        plan=_PLAN,
        problem=Problem.of("diverged", "The training diverged.") if state == "failed" else None,
        model=name if state == "succeeded" else None,
    )
    ended = job.model_dump(mode="json", exclude_none=True)
    lines = [
        json.dumps({"attempt": 1, "at": created.isoformat(), "level": "info", "message": f"line {line}"})
        for line in range(20)
    ]
    head = json.dumps({"format": FORMAT, "generation": 1, "job": ended})
    storage.put(layout.job_log(name), "\n".join([head, *lines, ""]).encode())
    if state == "succeeded":
        _store_model(storage, name, ended)


def _store_model(storage: Storage, name: str, ended: dict[str, object]) -> None:
    storage.put(layout.model_file(name, "model.ply"), ply())
    curve = [{"seconds": 3.0, "step": 100, "psnr": 27.5, "ssim": 0.9, "gaussians": 1}]
    report = {"curve": curve, "seconds": {"sfm": 1.0, "train": 3.0, "evaluate": 0.1}}
    storage.put(layout.model_file(name, "report.json"), json.dumps(report).encode())
    digests = dict.fromkeys(("model.ply", "report.json"), "0" * 64)
    record = ended | {"generation": 1, "format": FORMAT, "sha256": digests}
    storage.put(layout.job_record(name), json.dumps(record).encode())

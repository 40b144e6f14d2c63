"""Proves that a model is stored whole, under the record of its own generation, and only with a model.ply.

Does not prove that readers ignore a model without a record: tests/server does.
"""

import json
from pathlib import Path

import pytest
import redis

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage
from splatmill.schema import JobState, StateEvent
from splatmill_worker.service.attempt import Attempt
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.publish import is_published, publish
from tests.support.jobs import write_row

JOB = "job00001"


def attempt(connection: redis.Redis, generation: int) -> Attempt:
    return Attempt(connection, JOB, generation, 3, JobLock(connection, JOB, "token"))


def test_a_model_is_published_for_its_generation(
    local: Storage, connection: redis.Redis, tmp_path: Path
) -> None:
    for name in ("model.ply", "report.json", "notes.txt"):
        (tmp_path / name).write_text(name)
    first, second = attempt(connection, 1), attempt(connection, 2)
    row = write_row(connection, JOB)
    first.report(StateEvent(state=JobState.exporting))
    assert not is_published(local, first)
    publish(local, first, row, tmp_path)
    assert is_published(local, first)
    assert not is_published(local, second), "a restarted job is trained again"
    record = json.loads(local.get(layout.job_record(JOB)))
    assert (record["state"], record["model"], record["attempt"]) == ("succeeded", JOB, 3)
    stored = {entry.path.rsplit("/", 1)[-1] for entry in local.entries(layout.model(JOB))}
    assert stored == {"model.ply", "report.json", "job.json"}, (
        "other files of the folder are no part of a model"
    )


def test_without_a_model_nothing_is_published(
    local: Storage, connection: redis.Redis, tmp_path: Path
) -> None:
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"model\.ply"):
        publish(local, attempt(connection, 1), write_row(connection, JOB), tmp_path)
    assert list(local.entries(layout.model(JOB))) == []

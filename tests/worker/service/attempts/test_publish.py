"""Proves that a model is stored whole, under the record of its own generation, and only with a model.ply.

Does not prove that readers ignore a model without a record: tests/server does.
"""

import hashlib
import json
from pathlib import Path

import pytest
import redis

from splatmill.backplane.jobs.published import is_published
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import POSTER, JobState, StateEvent
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.publish import publish
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.room import Room
from tests.support.jobs import write_row

JOB = "job00001"


def attempt(connection: redis.Redis, generation: int) -> Attempt:
    return Attempt(connection, JOB, generation, 3, JobLock(connection, JOB, "token"))


def test_a_model_is_published_for_its_generation(
    room: Room, local: Storage, connection: redis.Redis, tmp_path: Path
) -> None:
    for name in ("model.ply", "report.json", "notes.txt"):
        (tmp_path / name).write_text(name)
    first = attempt(connection, 1)
    row = write_row(connection, JOB)
    first.report(StateEvent(state=JobState.exporting))
    assert not is_published(local, JOB, 1)
    publish(local, first, row, tmp_path, room)
    assert is_published(local, JOB, 1)
    assert not is_published(local, JOB, 2), "a restarted job is trained again"
    record = json.loads(local.get(layout.job_record(JOB)))
    assert (record["state"], record["model"], record["attempt"]) == ("succeeded", JOB, 3)
    stored = {entry.path.rsplit("/", 1)[-1] for entry in local.entries(layout.model(JOB))}
    assert stored == {"model.ply", "report.json", "job.json"}, (
        "other files of the folder are no part of a model"
    )


def test_files_in_folders_are_those_of_the_last_generation(
    room: Room, local: Storage, connection: redis.Redis, tmp_path: Path
) -> None:
    (tmp_path / "model.ply").write_text("splats")
    for name in ("held_out/000.webp", "held_out/001.webp", "time_lapse/000.ply", "film/000.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    row = write_row(connection, JOB)

    def stored() -> set[str]:
        folder = layout.model(JOB) + "/"
        return {entry.path.removeprefix(folder) for entry in local.entries(layout.model(JOB))}

    publish(local, attempt(connection, 1), row, tmp_path, room)
    common = {"model.ply", "job.json", "held_out/000.webp"}
    assert stored() == common | {"held_out/001.webp", "time_lapse/000.ply"}
    digests = json.loads(local.get(layout.job_record(JOB)))["sha256"]
    assert digests["held_out/000.webp"] == hashlib.sha256(b"held_out/000.webp").hexdigest()
    for name in ("held_out/001.webp", "time_lapse/000.ply"):
        (tmp_path / name).unlink()
    local.put(layout.model_file(JOB, POSTER), b"what the first generation looked like")
    local.put(layout.presentation(JOB), b"{}")
    publish(local, attempt(connection, 2), row, tmp_path, room)
    assert stored() == common | {"presentation.json"}, "what people have written is kept"


def test_without_a_model_nothing_is_published(
    room: Room, local: Storage, connection: redis.Redis, tmp_path: Path
) -> None:
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"model\.ply"):
        publish(local, attempt(connection, 1), write_row(connection, JOB), tmp_path, room)
    assert list(local.entries(layout.model(JOB))) == []

"""Folders for tiles of jobs that other workers have: one for each process, kept while the job lasts and no longer."""

from __future__ import annotations

import pytest
import redis

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill_worker.service.abandoned_folders import remove_abandoned, tidy
from splatmill_worker.service.job_folder import JobFolder, TileFolder, remove_remade
from tests.support.jobs import CAPTURE, write_row

JOB = "job00001"


def test_each_process_has_a_folder_of_its_own_and_the_next_tile_finds_its_photos(local: Storage) -> None:
    job = JobFolder(local, JOB, CAPTURE)
    first, second = TileFolder(local, JOB, CAPTURE), TileFolder(local, JOB, CAPTURE)
    assert len({job.path, first.path, second.path}) == 3
    assert first.stage_capture() == 3
    first.close()
    again = TileFolder(local, JOB, CAPTURE)
    assert again.path == first.path
    assert (again.capture / "images" / "a.jpg").read_text() == "a.jpg"


def test_they_go_with_the_end_of_the_job_unless_a_process_uses_them(
    local: Storage, connection: redis.Redis
) -> None:
    write_row(connection, JOB)
    connection.sadd(keys.ACTIVE, JOB)
    used, left = TileFolder(local, JOB, CAPTURE), TileFolder(local, JOB, CAPTURE)
    left.close()
    tidy(connection, JOB)
    remove_abandoned(connection)
    assert left.path.exists()
    connection.delete(keys.job(JOB))
    tidy(connection, JOB)
    assert (used.path.exists(), left.path.exists()) == (True, False)
    used.close()
    remove_abandoned(connection)
    assert used.path.exists()  # the job may only be unknown for a moment
    connection.srem(keys.ACTIVE, JOB)
    remove_abandoned(connection)
    assert not used.path.exists()


def test_an_attempt_on_another_machine_gets_units_by_their_plan_alone(remote: Storage) -> None:
    remote.put(f"{layout.job_units(JOB)}/plan.json", b"{}")
    remote.put(f"{layout.job_work(JOB)}/plan.json", b"{}")
    folder = JobFolder(remote, JOB, CAPTURE)
    assert folder.restore() == ["plan.json"]
    folder.remove()
    assert list(remote.entries(layout.job(JOB))) == []


@pytest.mark.parametrize("where", ["local", "remote"])
def test_units_outlive_a_failure_of_the_job_and_go_with_its_end(
    where: str, request: pytest.FixtureRequest
) -> None:
    storage: Storage = request.getfixturevalue(where)
    folder = JobFolder(storage, JOB, CAPTURE)
    units = folder.run / "tiles" / "units"
    for path in (
        "checkpoints/1",
        "tiles/units/coarse-1/done.json",
        "tiles/units/tile-1-1.ab.work/frames/1.jpg",
    ):
        (folder.run / path).parent.mkdir(parents=True)
        (folder.run / path).touch()
    plan = f"{layout.job_units(JOB)}/plan.json"
    storage.put(plan, b"{}")
    folder.reset()
    assert storage.exists(plan)
    assert sorted(path.name for path in folder.run.iterdir()) == ["tiles"]
    assert remove_remade(folder.path)
    assert [path.name for path in units.iterdir()] == ["coarse-1"]
    folder.remove()
    assert list(storage.entries(layout.job(JOB))) == []

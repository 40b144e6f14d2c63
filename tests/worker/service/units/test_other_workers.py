"""What other workers are given: tiles and copies of what these need, as long as the owner's storage has room for them.

Does not prove that they train the tiles: tests/service/test_tiles.py does.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import redis

from splatmill.backplane import reservations
from splatmill.backplane.queue import entries, lines
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import TrainOptions
from splatmill_worker.service.job_folder import JobFolder
from splatmill_worker.service.room import Room
from splatmill_worker.service.units.other_workers import OtherWorkers
from splatmill_worker.tiles.folder import PlanFolder
from splatmill_worker.tiles.units import ScenePlan
from tests.support.jobs import CAPTURE, write_row

JOB = "job00001"


@pytest.mark.parametrize("fits", [True, False])
def test_tiles_are_offered_only_where_their_copies_fit_into_the_quota(
    local: Storage, connection: redis.Redis, room: Room, tmp_path: Path, fits: bool
) -> None:
    options = TrainOptions(tiles=2)
    write_row(connection, JOB, options=options)
    reservations.note_limit(connection, "default", 10_000 if fits else 2_000)
    plan, warnings = PlanFolder(tmp_path / "plan", ScenePlan("d", options)), list[str]()
    with plan.claimed("cameras") as run:
        run.publish({})
    job = JobFolder(local, JOB, CAPTURE)
    try:
        others = OtherWorkers(connection, job, 1, room, warnings.append)
        others.begin(plan)
        with plan.claimed("coarse") as run:
            run.out.mkdir()
            run.out.joinpath("a").write_bytes(b"1")
            run.out.joinpath("b").write_bytes(bytes(3_000))
            run.publish({})
        before = reservations.used(connection, "default")
        others.stored(plan.output("coarse"))
        others.offer(["tile-1", "tile-2"])
        others.gather(plan)
    finally:
        job.remove()
    names = {entry.path.split("/")[-2].rpartition("-")[0] for entry in local.entries(layout.job_units(JOB))}
    tiles = [entries.unit_id(JOB, 1, tile) for tile in (1, 2)]
    assert len(lines.look(connection, tiles).places) == (2 if fits else 0)
    assert ("coarse" in names) == fits
    if fits:
        assert warnings == []
        return
    assert reservations.used(connection, "default") == before
    (warning,) = warnings
    assert warning.startswith("No other worker is given tiles of this job from now on")
    assert "2 kB in storage, and the job needs 3" in warning

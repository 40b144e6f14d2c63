"""What other workers are given: tiles and copies of what these need, as long as the owner's storage has room for them.

Does not prove that they train the tiles: tests/service/test_tiles.py does.
"""

from __future__ import annotations

from collections.abc import Iterator
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
from splatmill_worker.service.units.stored_units import StoredUnits
from splatmill_worker.tiles.folder import PlanFolder
from splatmill_worker.tiles.units import ScenePlan
from tests.support.jobs import CAPTURE, write_row

JOB = "job00001"
TILES = [entries.unit_id(JOB, 1, tile) for tile in (1, 2)]


@pytest.fixture
def plan(tmp_path: Path) -> PlanFolder:
    """The folder of the attempt, which has the cameras, and the coarse model in 3 kB."""
    folder = PlanFolder(tmp_path / "plan", ScenePlan("d", TrainOptions(tiles=2)))
    for name, size in (("cameras", 1), ("coarse", 3_000)):
        with folder.claimed(name) as run:
            run.out.mkdir()
            run.out.joinpath("a").write_bytes(b"1")
            run.out.joinpath("b").write_bytes(bytes(size))
            run.publish({})
    return folder


@pytest.fixture
def warnings() -> list[str]:
    return []


@pytest.fixture
def others(
    local: Storage, connection: redis.Redis, room: Room, warnings: list[str]
) -> Iterator[OtherWorkers]:
    write_row(connection, JOB, options=TrainOptions(tiles=2))
    job = JobFolder(local, JOB, CAPTURE)
    yield OtherWorkers(connection, job, 1, room, warnings.append)
    job.remove()


def waiting(connection: redis.Redis) -> int:
    return len(lines.look(connection, TILES).places)


def stored(storage: Storage) -> dict[str, int]:
    """Bytes of each unit in storage, by its name."""
    sizes: dict[str, int] = {}
    for entry in storage.entries(layout.job_units(JOB)):
        name = entry.path.removeprefix(layout.job_units(JOB) + "/").partition("/")[0].rpartition("-")[0]
        sizes[name] = sizes.get(name, 0) + entry.size
    return {name: size for name, size in sizes.items() if name}


def test_tiles_are_offered_where_their_copies_fit_and_all_copies_are_counted(
    local: Storage, connection: redis.Redis, others: OtherWorkers, plan: PlanFolder, warnings: list[str]
) -> None:
    reservations.note_limit(connection, "default", 10_000)
    others.begin(plan)
    others.offer(["tile-1", "tile-2"])
    assert waiting(connection) == 2
    sizes = stored(local)
    assert set(sizes) == {"cameras", "coarse"}
    assert reservations.used(connection, "default") == sum(sizes.values())
    assert warnings == []


def test_what_no_unit_needs_any_more_is_deleted_and_leaves_its_room_to_others(
    local: Storage, connection: redis.Redis, others: OtherWorkers, plan: PlanFolder, warnings: list[str]
) -> None:
    reservations.note_limit(connection, "default", 10_000)
    with plan.claimed("features-1") as run:
        run.out.joinpath("sfm").mkdir(parents=True)
        run.out.joinpath("sfm", "database.db").write_bytes(bytes(5_000))
        run.publish({})
    others.begin(plan)
    before = stored(local)
    assert set(before) == {"features-1", "cameras", "coarse"}
    assert reservations.used(connection, "default") == sum(before.values())
    others.forget([plan.output("features-1"), plan.output("features-2")])
    left = stored(local)
    assert left == {name: before[name] for name in ("cameras", "coarse")}
    with plan.claimed("tile-1") as run:
        run.out.mkdir()
        run.out.joinpath("c").write_bytes(bytes(5_000))
        run.publish({})
    others.stored(plan.output("tile-1"))
    assert "tile-1" in stored(local)
    assert warnings == []
    assert reservations.used(connection, "default") == sum(before.values())


def test_without_room_for_copies_no_tile_is_offered_and_nothing_more_is_stored(
    local: Storage, connection: redis.Redis, others: OtherWorkers, plan: PlanFolder, warnings: list[str]
) -> None:
    reservations.note_limit(connection, "default", 2_000)
    others.begin(plan)
    others.offer(["tile-1", "tile-2"])
    assert waiting(connection) == 0
    sizes = stored(local)
    assert set(sizes) == {"cameras"}
    assert reservations.used(connection, "default") == sizes["cameras"]
    (warning,) = warnings
    assert warning.startswith(
        "This worker does all parts that no other has begun: copies for other workers do not fit."
    )
    assert "of 2.0 kB in storage" in warning


def test_once_there_is_room_again_parts_are_offered_again(
    local: Storage, connection: redis.Redis, others: OtherWorkers, plan: PlanFolder
) -> None:
    with plan.claimed("features-1") as run:
        run.out.mkdir()
        run.out.joinpath("a").write_bytes(bytes(3_500))
        run.publish({})
    reservations.note_limit(connection, "default", 5_000)
    others.begin(plan)
    assert set(stored(local)) == {"features-1", "cameras"}, "the coarse model does not fit"
    others.offer(["tile-1"])
    assert waiting(connection) == 0
    others.forget([plan.output("features-1")])
    others.stored(plan.output("coarse"))
    others.offer(["tile-1"])
    assert set(stored(local)) == {"cameras", "coarse"}
    assert waiting(connection) == 1


def test_another_machine_fetches_what_is_needed_yet(
    local: Storage, others: OtherWorkers, plan: PlanFolder, tmp_path: Path
) -> None:
    with plan.claimed("features-1") as run:
        run.publish({})
    others.begin(plan)
    fresh = PlanFolder(tmp_path / "fresh", plan.plan)
    others.begin(fresh)
    assert set(fresh.states()) == {"cameras", "coarse"}
    assert set(stored(local)) == {"features-1", "cameras", "coarse"}


def test_where_room_ends_tiles_that_nobody_has_begun_are_taken_back_and_those_of_others_are_counted(
    local: Storage,
    connection: redis.Redis,
    others: OtherWorkers,
    plan: PlanFolder,
    warnings: list[str],
    tmp_path: Path,
) -> None:
    reservations.note_limit(connection, "default", 10_000)
    others.begin(plan)
    others.offer(["tile-1", "tile-2"])
    elsewhere = PlanFolder(tmp_path / "elsewhere", plan.plan)
    taken = lines.take(connection, "tester", lines.LINES)
    assert taken is not None
    assert taken[0].entry == TILES[0]
    StoredUnits(local, JOB).bring(elsewhere)
    with elsewhere.claimed("tile-1") as run:
        run.out.mkdir()
        run.out.joinpath("c").write_bytes(bytes(9_000))
        run.publish({})
    StoredUnits(local, JOB).put(elsewhere.output("tile-1"))
    others.gather(plan)
    assert "tile-1" in plan.states()
    assert reservations.used(connection, "default") == sum(stored(local).values()) > 10_000
    assert warnings == []
    with plan.claimed("tile-2") as run:
        run.publish({})
    for _ in range(2):
        others.stored(plan.output("tile-2"))
    assert waiting(connection) == 0
    assert "tile-2" not in stored(local)
    assert len(warnings) == 1
    assert others.take_back("tile-2")

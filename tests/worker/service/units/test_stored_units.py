"""Units in storage: an output is there whole or not at all, and another version's plan is not followed.

Does not prove what workers make of them: tests/service/test_tiles.py does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import TrainOptions
from splatmill_worker.service.units.stored_units import VERSION, StoredUnits
from splatmill_worker.tiles.folder import DONE, PLAN, PlanFolder, facts_of
from splatmill_worker.tiles.units import ScenePlan

JOB = "job00001"
SCENE = ScenePlan("digest", TrainOptions(tiles=2))


@pytest.fixture(params=["local", "remote"])
def storage(request: pytest.FixtureRequest) -> Storage:
    store: Storage = request.getfixturevalue(request.param)
    return store


@pytest.fixture
def here(tmp_path: Path) -> PlanFolder:
    """The folder of one worker, which has the cameras."""
    folder = PlanFolder(tmp_path / "here", SCENE)
    with folder.claimed("cameras") as run:
        (run.out / "sfm").mkdir(parents=True)
        (run.out / "sfm" / "points").write_bytes(b"123")
        run.publish({"photos": 3})
    return folder


@pytest.fixture
def there(tmp_path: Path) -> PlanFolder:
    """The folder of another worker, which has nothing."""
    return PlanFolder(tmp_path / "there", SCENE)


def stored_of(storage: Storage) -> list[str]:
    prefix = layout.job_units(JOB)
    return sorted(entry.path.removeprefix(prefix + "/") for entry in storage.entries(prefix))


def test_outputs_for_which_there_is_no_room_are_not_brought(
    storage: Storage, here: PlanFolder, there: PlanFolder
) -> None:
    units, asked = StoredUnits(storage, JOB), list[int]()

    def refuse(files: Mapping[Path, Entry]) -> None:
        asked.append(sum(entry.size for entry in files.values()))
        raise OSError("full")

    units.put(here.output("cameras"))
    with pytest.raises(OSError, match="full"):
        units.bring(there, check=refuse)
    assert asked == [3 + (here.output("cameras") / DONE).stat().st_size]
    assert there.states() == {}
    assert [name.partition("/")[2] for name, _ in units.bring(there)] == [DONE, "sfm/points"]


def test_what_one_worker_did_is_found_by_another(
    storage: Storage, here: PlanFolder, there: PlanFolder
) -> None:
    units, rooms = StoredUnits(storage, JOB), dict[str, int]()
    output = here.ended()["cameras"].path
    assert output is not None
    units.put(output, rooms.update)
    assert {name.removeprefix(f"{output.name}/"): size for name, size in rooms.items()} == {
        "sfm/points": 3,
        DONE: len((output / DONE).read_bytes()),
    }
    brought = units.bring(there)
    assert sorted(brought) == sorted(rooms.items())
    assert there.states() == {"cameras": "done"}
    assert (there.output("cameras") / "sfm" / "points").read_bytes() == b"123"
    assert units.bring(there) == []


def test_an_output_without_its_last_file_is_left_alone(
    storage: Storage, here: PlanFolder, there: PlanFolder
) -> None:
    units, output = StoredUnits(storage, JOB), here.output("cameras")
    units.put(output)
    storage.delete(f"{layout.job_units(JOB)}/{output.name}/{DONE}")
    assert units.bring(there) == []
    assert there.states() == {}
    units.put(output)  # by a worker that does the unit again
    assert len(units.bring(there)) == 2


def test_an_output_that_is_stored_is_not_stored_again(storage: Storage, here: PlanFolder) -> None:
    units, output = StoredUnits(storage, JOB), here.output("cameras")
    units.put(output)
    before = stored_of(storage)
    storage.put(f"{layout.job_units(JOB)}/{output.name}/sfm/points", b"of another")
    units.put(output)
    assert stored_of(storage) == before
    assert storage.get(f"{layout.job_units(JOB)}/{output.name}/sfm/points") == b"of another"


def test_the_plan_of_another_version_is_not_followed(storage: Storage) -> None:
    units, path = StoredUnits(storage, JOB), f"{layout.job_units(JOB)}/{PLAN}"
    assert units.plan() is None
    units.put_plan(SCENE)
    assert units.plan() == SCENE
    document = json.loads(storage.get(path))
    storage.put(path, json.dumps(document | {VERSION: "0.0.0"}).encode())
    assert units.plan() is None


def test_the_output_that_is_stored_is_preferred_to_that_of_another_run(
    storage: Storage, here: PlanFolder, there: PlanFolder
) -> None:
    units = StoredUnits(storage, JOB)
    units.put(here.output("cameras"))
    with there.claimed("cameras") as run:
        run.publish({"photos": 2})
    units.drop_others(here)
    units.drop_others(there)
    assert (here.states(), there.states()) == ({"cameras": "done"}, {})
    units.bring(there, only=("coarse",))
    assert there.states() == {}
    units.bring(there)
    assert facts_of(there.output("cameras")) == {"photos": 3}

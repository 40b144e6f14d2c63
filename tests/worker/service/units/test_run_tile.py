"""How a tile that another worker has ended is settled, by its own error or by that of the disk, and which photos are
fetched for the features of a block.

Does not prove that a tile is trained: tests/service/test_tiles.py does.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import redis
from PIL import Image

from splatmill.backplane.jobs.row import now
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import TrainOptions
from splatmill_worker import synthetic
from splatmill_worker.service.job_folder import tile_folders
from splatmill_worker.service.process_exit import WITHDRAWN_STATUS
from splatmill_worker.service.units import run_tile as run_tile_module
from splatmill_worker.service.units import stored_units
from splatmill_worker.service.units.run_tile import TileEntry, run_tile
from splatmill_worker.service.units.stored_units import StoredUnits
from splatmill_worker.sfm.features import photos_in
from splatmill_worker.sfm.mapping import clusters
from splatmill_worker.tiles.folder import PlanFolder, facts_of
from splatmill_worker.tiles.stages import Context, run_unit
from splatmill_worker.tiles.units import ScenePlan
from tests.support.jobs import write_row

JOB = "job00001"


@pytest.fixture
def entry(
    local: Storage, connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> TileEntry:
    """A tile whose coarse model is stored without its files."""
    monkeypatch.setenv("SPLATMILL_STORAGE", (tmp_path / "storage").as_uri())
    options = TrainOptions(tiles=2)
    write_row(connection, JOB, options=options)
    plan = ScenePlan("d", options)
    made, units = PlanFolder(tmp_path / "made", plan), StoredUnits(local, JOB)
    units.put_plan(plan)
    for name in ("cameras", "coarse"):
        with made.claimed(name) as run:
            run.publish({})
        units.put(made.output(name))
    return TileEntry(connection, JOB, 1, 1)


def test_an_error_of_the_system_is_for_the_queue_to_try_again(entry: TileEntry) -> None:
    with pytest.raises(FileNotFoundError, match="coarse"):
        run_tile(entry)
    (folder,) = tile_folders(JOB)
    assert sorted(path.name for path in folder.iterdir()) == ["lock", "run"], "the photos are not fetched"


def test_a_failure_with_a_name_leaves_the_tile_to_the_attempt(
    entry: TileEntry, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SPLATMILL_DISK_RESERVE", "1000TB")
    with caplog.at_level(logging.WARNING, "splatmill.attempt"):
        run_tile(entry)
    assert "tile-1 of the job job00001 failed here" in caplog.text
    assert "stay free" in caplog.text


def statuses_of(entry: TileEntry, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The status with which the process of a tile exits early; empty where it ends by itself."""
    statuses: list[int] = []

    def leave(status: int) -> None:
        statuses.append(status)
        raise SystemExit

    monkeypatch.setattr(os, "_exit", leave)
    with suppress(SystemExit):
        run_tile(entry)
    return statuses


def restarted(entry: TileEntry) -> None:
    write_row(entry.connection, JOB, generation=2)


def cancelled(entry: TileEntry) -> None:
    write_row(entry.connection, JOB, cancel_requested_at=now())


def deleted(entry: TileEntry) -> None:
    entry.connection.flushdb()


ENDS = pytest.mark.parametrize("end", [restarted, cancelled, deleted])


@ENDS
def test_a_tile_of_a_job_that_is_over_is_withdrawn_before_it_begins(
    entry: TileEntry, monkeypatch: pytest.MonkeyPatch, end: Callable[[TileEntry], None]
) -> None:
    end(entry)
    assert statuses_of(entry, monkeypatch) == [WITHDRAWN_STATUS]


@ENDS
@pytest.mark.parametrize("lost", [True, False], ids=["plan", "coarse model"])
def test_a_tile_that_lacks_files_of_a_job_that_is_over_is_withdrawn(
    entry: TileEntry,
    local: Storage,
    monkeypatch: pytest.MonkeyPatch,
    end: Callable[[TileEntry], None],
    lost: bool,
) -> None:
    class EndsMeanwhile(StoredUnits):
        def plan(self) -> ScenePlan | None:
            end(entry)
            return None if lost else super().plan()

    monkeypatch.setattr(run_tile_module, "StoredUnits", EndsMeanwhile)
    assert statuses_of(entry, monkeypatch) == [WITHDRAWN_STATUS]


def test_a_plan_of_another_version_leaves_the_tile_to_the_attempt(
    entry: TileEntry, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stored_units, "__version__", "0.0.0")
    assert statuses_of(entry, monkeypatch) == []
    assert "made by another version" in caplog.text


@pytest.mark.slow
def test_features_and_matches_are_found_on_another_machine_with_the_photos_of_the_block(
    local: Storage, connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATMILL_STORAGE", (tmp_path / "storage").as_uri())
    options = TrainOptions(tiles=2)
    write_row(connection, JOB, options=options, capture="capture2")
    capture = tmp_path / "capture"
    synthetic.capture(capture / "images", 5, 160, 120, samples=1)
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 2)
    names = sorted(path.name for path in (capture / "images").iterdir())
    masks = [f"{Path(name).stem}.png" for name in names]
    (capture / "masks").mkdir()
    for number, name in enumerate(masks):
        shown = np.full((120, 160), 255, np.uint8)
        shown[:, : 1 + number] = 0
        Image.fromarray(shown).save(capture / "masks" / name)
    for path in sorted(path for path in capture.rglob("*") if path.is_file()):
        local.put(f"{layout.capture_files('capture2')}/{path.relative_to(capture).as_posix()}", path)
    plan = ScenePlan("d", options)
    made, units = PlanFolder(tmp_path / "made", plan), StoredUnits(local, JOB)
    made.place(capture)
    units.put_plan(plan)

    def here(name: str) -> None:
        with made.claimed(name) as run:
            run_unit(Context(made, run, lambda event: None, lambda: False))
        units.put(made.output(name))

    def elsewhere(name: str) -> Path:
        """The work folder of the other machine."""
        run_tile(TileEntry(connection, JOB, 1, plan.part_names.index(name) + 1))
        units.bring(made)
        (folder,) = tile_folders(JOB)
        return folder

    def database(name: str) -> Path:
        output = made.ended()[name].path
        assert output is not None
        (path,) = output.rglob("database.db")
        return path

    here("photos")
    folder = elsewhere("features-2")
    staged = {path.parent.name: path.name for path in (folder / "capture").rglob("*") if path.is_file()}
    assert sorted(path.name for path in (folder / "capture" / "images").iterdir()) == names[2:]
    assert sorted(path.name for path in (folder / "capture" / "masks").iterdir()) == masks[2:]
    assert set(staged) == {"images", "masks"}
    assert facts_of(database("features-2").parents[3])["photos"] == 3
    assert photos_in(database("features-2"), with_features=True) == {2, 3, 4}
    here("features-1")
    here("pairs")
    shutil.rmtree(folder / "capture")
    elsewhere("matches-1")
    here("matches-2")
    assert not (folder / "capture").exists(), "matches need no photo"
    assert database("matches-1").relative_to(made.output("matches-1")) == database("features-2").relative_to(
        made.output("features-2")
    )
    elsewhere("mapping-1")
    here("mapping-2")
    assert not (folder / "capture").exists(), "mapping needs no photo"
    for name in ("mapping-1", "mapping-2"):
        output = made.ended()[name].path
        assert output is not None
        assert facts_of(output)["photos"] == 0, "that these small photos are not placed by"
    with made.claimed("cameras") as run:  # that these small photos do not have
        run.publish({})
    units.put(made.output("cameras"))
    units.drop([made.output("features-2").name])
    elsewhere("features-2")  # whose entry the queue has given once more
    assert not units.has(made.output("features-2").name)
    both = [facts_of(database(name).parents[3])["pairs"] for name in ("matches-1", "matches-2")]
    assert both == [5, 5], "of ten pairs"

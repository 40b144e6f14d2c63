"""How a tile that another worker has ended is settled: by its own error, or by that of the disk.

Does not prove that a tile is trained: tests/service/test_tiles.py does.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import redis

from splatmill.backplane.jobs.row import now
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import TrainOptions
from splatmill_worker.service.job_folder import tile_folders
from splatmill_worker.service.process_exit import WITHDRAWN_STATUS
from splatmill_worker.service.units import run_tile as run_tile_module
from splatmill_worker.service.units import stored_units
from splatmill_worker.service.units.run_tile import TileEntry, run_tile
from splatmill_worker.service.units.stored_units import StoredUnits
from splatmill_worker.tiles.folder import PlanFolder
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

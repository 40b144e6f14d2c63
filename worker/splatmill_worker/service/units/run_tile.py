"""A tile of a job that another worker has: trained and stored, in a process of its own (see `rq_worker`)."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import redis

from splatmill.backplane.jobs import events
from splatmill.backplane.jobs import row as rows
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage.storage import Storage
from splatmill_worker.errors import WorkerError
from splatmill_worker.service import hand_back
from splatmill_worker.service.disk_reserve import DiskWatch
from splatmill_worker.service.job_folder import ENDED, TileFolder
from splatmill_worker.service.process_exit import HANDED_BACK_STATUS, WITHDRAWN_STATUS
from splatmill_worker.service.redis_patience import patiently
from splatmill_worker.service.units.stored_units import StoredUnits
from splatmill_worker.settings import storage_url
from splatmill_worker.tiles.folder import PlanFolder
from splatmill_worker.tiles.units import ScenePlan

POLL_SECONDS = 0.5
"""Seconds between two questions whether the job still runs."""

RESTORE_SECONDS = 30.0
"""Seconds without a row of the job after which it counts as deleted."""

log = logging.getLogger("splatmill.attempt")


@dataclass(frozen=True)
class TileEntry:
    """A tile that the queue has given to this process.

    connection: the service's Redis.
    job_id, generation: the job.
    tile: number of the unit among those that several machines do at a time (`ScenePlan.part_names`), from 1.
    """

    connection: redis.Redis
    job_id: str
    generation: int
    tile: int


def run_tile(entry: TileEntry) -> None:
    """Train a tile and store it, in a process forked for it. What it does not do, the attempt that has the job does.

    The process exits with WITHDRAWN_STATUS once the job has ended or is to be cancelled, wherever it is, and with
    HANDED_BACK_STATUS when the worker stops. Raises errors of storage, Redis and the system, which the queue is to try
    again.
    """
    row = _row_or_exit(entry)
    watch = _JobWatch(entry)
    disk = DiskWatch()

    def stopped() -> bool:
        return hand_back.requested() or disk.error is not None

    try:
        _train(entry, row, stopped)
    except Exception as caught:
        if hand_back.requested():
            os._exit(HANDED_BACK_STATUS)
        _row_or_exit(entry)
        error = disk.error or caught
        if not isinstance(error, WorkerError):
            raise
        log.warning("%s of the job %s failed here: %s", _name(entry, row), entry.job_id, error)
    finally:
        watch.close()
        disk.close()


def _name(entry: TileEntry, row: JobRow) -> str:
    """The name of the unit."""
    return ScenePlan("", row.options).part_names[entry.tile - 1]


def _train(entry: TileEntry, row: JobRow, stopped: Callable[[], bool]) -> None:
    storage = Storage(storage_url())
    units = StoredUnits(storage, entry.job_id)
    plan = units.plan()
    if plan is None:
        _row_or_exit(entry)
        log.warning("the plan of the job %s is gone, or was made by another version", entry.job_id)
        return
    name = plan.part_names[entry.tile - 1]
    folder = TileFolder(storage, entry.job_id, row.capture)
    try:
        folder.run.mkdir(parents=True, exist_ok=True)
        tiles = PlanFolder(folder.run, plan)
        tiles.release()
        if _is_unneeded(units, tiles, name):
            return
        units.bring(tiles, only=(*plan.unit(name).needs, name), check=folder.check_space)
        if name in tiles.states() or tiles.plan.missing(name, tiles.states()):
            return
        # Not imported by the worker that forks this process: numpy and torch start threads.
        from splatmill_worker.images.decoding import decoders
        from splatmill_worker.tiles.camera_parts import block_of, files_of_block
        from splatmill_worker.tiles.stages import Context, run_unit

        if name in plan.feature_names:
            photos = files_of_block(tiles.output("photos"), block_of(name, plan.blocks))
            folder.stage_capture(only=photos)
            tiles.place(folder.capture)
        with (
            tiles.claimed(name) as run,
            decoders.confined([folder.path], run.work / ENDED, stopped),
        ):
            run_unit(Context(tiles, run, lambda event: None, stopped))
        if not _is_unneeded(units, tiles, name):
            units.put(run.path)
    finally:
        folder.close()


def _is_unneeded(units: StoredUnits, tiles: PlanFolder, name: str) -> bool:
    """Whether the unit is one of those that only the cameras need, and these are there."""
    return name in tiles.plan.camera_names and units.has(tiles.output("cameras").name)


def _row_or_exit(entry: TileEntry) -> JobRow:
    """The row of the job. Exits the process with WITHDRAWN_STATUS where the job needs the tile no longer.

    Asked also after a failure: what a job has in storage is deleted once it has ended.
    """
    row = patiently(lambda: _row_to_help(entry))
    if row is None:
        log.info("the job %s needs its unit %d no longer", entry.job_id, entry.tile)
        os._exit(WITHDRAWN_STATUS)
    return row


def _row_to_help(entry: TileEntry) -> JobRow | None:
    """The row of the job; None when it was deleted or restarted, is to be cancelled, or has ended."""
    row = rows.read(entry.connection, entry.job_id)
    if row is None or row.generation != entry.generation or row.cancel_requested_at is not None:
        return None
    return None if fold(row, events.read_states(entry.connection, entry.job_id)).state.final else row


class _JobWatch:
    """Ends this process, from a thread, when the job has ended or is to be cancelled: at once, also in native code."""

    def __init__(self, entry: TileEntry) -> None:
        self._entry = entry
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="job watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        known = time.monotonic()
        while not self._stop.wait(POLL_SECONDS):
            try:
                if rows.read(self._entry.connection, self._entry.job_id) is not None:
                    known = time.monotonic()
                    over = _row_to_help(self._entry) is None
                else:
                    # Deleted, or in a Redis that came back empty and that a server fills again.
                    over = time.monotonic() - known > RESTORE_SECONDS
            except redis.RedisError:
                continue
            if over:
                os._exit(WITHDRAWN_STATUS)

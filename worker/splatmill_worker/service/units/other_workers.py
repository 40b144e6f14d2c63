"""Other workers, which do tiles of a job beside the attempt that has it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

import redis

from splatmill.backplane.queue import queue
from splatmill_worker.errors import QuotaReached
from splatmill_worker.service.job_folder import JobFolder
from splatmill_worker.service.redis_patience import patiently
from splatmill_worker.service.room import Room
from splatmill_worker.service.units.stored_units import StoredUnits
from splatmill_worker.tiles.folder import PlanFolder


class OtherWorkers:
    """The workers of a service, to which the queue gives tiles that the attempt has not begun.

    A tile waits in the queue until a worker takes it, or the attempt takes it back to do it itself. So nobody waits for
    a worker that does not come, and no tile is done by two unless one of them is lost.

    Where the owner's quota has no room for copies of what they need, no part is begun by them from then on.
    """

    def __init__(
        self,
        connection: redis.Redis,
        folder: JobFolder,
        generation: int,
        room: Room,
        warn: Callable[[str], None],
    ) -> None:
        """folder: of the job, on this machine. warn: called with sentences where there is no room."""
        self._connection, self._job_id, self._generation = connection, folder.job_id, generation
        self._room, self._job_folder, self._warn = room, folder, warn
        self._alone = False
        self._units = StoredUnits(folder.storage, folder.job_id)
        self._numbers: dict[str, int] = {}
        self._offered: set[str] = set()

    def begin(self, folder: PlanFolder) -> None:
        """Store the plan and what this machine has done of it, and bring what earlier attempts have done elsewhere."""
        self._numbers = {name: number for number, name in enumerate(folder.plan.part_names, 1)}
        self._units.put_plan(folder.plan)
        self._units.drop_others(folder)
        self._bring(folder, ("cameras",))
        self.gather(folder)
        for ended in folder.ended().values():
            if ended.path is not None:
                self.stored(ended.path)

    def stored(self, output: Path) -> None:
        """Store the output of a unit, if the owner's storage has room for it."""
        if self._alone:
            return
        try:
            self._units.put(output, self._room.store)
        except QuotaReached as error:
            self._alone = True
            self.end()
            self._warn(
                f"This worker does all parts that no other has begun: copies for other workers do not fit. {error}"
            )

    def offer(self, tiles: Sequence[str]) -> None:
        """Put tiles into the queue, each once."""
        for name in tiles:
            if name not in self._offered and not self._alone:
                self._offered.add(name)
                patiently(partial(self._on, queue.offer_tile, name))

    def take_back(self, tile: str) -> bool:
        """Take a tile out of the queue; returns whether no other worker has it."""
        return patiently(partial(self._on, queue.take_back_tile, tile))

    def gather(self, folder: PlanFolder) -> None:
        """Bring the outputs of others into the folder of the plan, and count them for the owner of the job."""
        self._bring(folder, folder.plan.needed(folder.states()))

    def forget(self, outputs: Sequence[Path]) -> None:
        """Delete outputs from storage. Their room in the owner's quota is for what the job stores next."""
        dropped = self._units.drop([path.name for path in outputs])
        if dropped:
            self._room.store(dict.fromkeys(dropped, 0), may_refuse=False)
            self._alone = False  # until copies do not fit again

    def end(self) -> None:
        """Take all tiles out of the queue that no worker has begun."""
        for tile in sorted(self._offered):
            patiently(partial(self._on, queue.take_back_tile, tile))

    def _bring(self, folder: PlanFolder, only: Collection[str]) -> None:
        brought = dict(self._units.bring(folder, only, self._job_folder.check_space))
        if brought:
            self._room.store(brought, may_refuse=False)

    def _on(self, act: Callable[[redis.Redis, str, int, int], bool], name: str) -> bool:
        return act(self._connection, self._job_id, self._generation, self._numbers[name])

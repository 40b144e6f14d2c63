"""The units of a job in storage: its plan, and a folder for each output, whose last file is stored last."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from splatmill import __version__
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill_worker.service import staging
from splatmill_worker.tiles.folder import DONE, PLAN, UNITS, PlanFolder
from splatmill_worker.tiles.units import ScenePlan

VERSION = "version"
"""Field of the stored plan with the version of the program that made it: others may train differently."""


class StoredUnits:
    """The units of one job, as any worker reads and writes them.

    storage: where they are.
    job_id: the job.
    """

    def __init__(self, storage: Storage, job_id: str) -> None:
        self._storage = storage
        self._prefix = layout.job_units(job_id)

    def put_plan(self, plan: ScenePlan) -> None:
        """Store the plan."""
        document = plan.as_dict() | {VERSION: __version__}
        self._storage.put(f"{self._prefix}/{PLAN}", json.dumps(document).encode())

    def plan(self) -> ScenePlan | None:
        """The stored plan; None where there is none, or another version of the program made it."""
        path = f"{self._prefix}/{PLAN}"
        if not self._storage.exists(path):
            return None
        document = json.loads(self._storage.get(path))
        if document.get(VERSION) != __version__:
            return None
        return ScenePlan.from_dict(document)

    def put(self, output: Path, room: Callable[[Mapping[str, int]], None] = lambda files: None) -> None:
        """Store the output of a unit, its last file last, unless it is stored.

        room: called with the names and sizes of the files before one of them is stored.
        """
        target, last = f"{self._prefix}/{output.name}", output / DONE
        files = [*(path for path in sorted(output.rglob("*")) if path.is_file() and path != last), last]
        names = [path.relative_to(output).as_posix() for path in files]
        room({f"{output.name}/{name}": path.stat().st_size for path, name in zip(files, names, strict=True)})
        if not self.has(output.name):
            for path, name in zip(files, names, strict=True):
                self._storage.put(f"{target}/{name}", path)

    def has(self, output: str) -> bool:
        """Whether the output is stored whole. output: name of its folder."""
        return self._storage.exists(f"{self._prefix}/{output}/{DONE}")

    def drop(self, outputs: Sequence[str]) -> list[str]:
        """Delete outputs, the last file of each first. Return the names of their files.

        outputs: names of their folders.
        """
        dropped = []
        for output in outputs:
            folder = f"{self._prefix}/{output}"
            entries = [entry.path for entry in self._storage.entries(folder)]
            self._storage.delete(f"{folder}/{DONE}")  # without it, others take the rest for no output
            self._storage.delete_prefix(folder)
            dropped += [path.removeprefix(f"{self._prefix}/") for path in entries]
        return dropped

    def drop_others(self, folder: PlanFolder) -> None:
        """Remove outputs from the folder of the plan where others are stored, which tiles may follow from."""
        for ended in folder.ended().values():
            if ended.path is None:
                continue
            stored = f"{self._prefix}/{ended.path.name}/{DONE}"
            if self._storage.exists(stored) and self._storage.get(stored) != (ended.path / DONE).read_bytes():
                shutil.rmtree(ended.path)

    def bring(
        self,
        folder: PlanFolder,
        only: Collection[str] | None = None,
        check: Callable[[Mapping[Path, Entry]], None] = lambda files: None,
    ) -> list[tuple[str, int]]:
        """Copy the outputs that the folder of the plan lacks into it. Return the names and sizes of their files.

        only: names of the units whose outputs are wanted; None: all.
        check: called with the files of an output and where they will be, before these are copied.
        """
        outputs: dict[str, dict[str, Entry]] = defaultdict(dict)
        for entry in self._storage.entries(self._prefix):
            output, _, name = entry.path.removeprefix(f"{self._prefix}/").partition("/")
            if only is not None and output.rpartition("-")[0] not in only:
                continue
            if name and not (folder.root / UNITS / output / DONE).is_file():
                outputs[output][name] = entry
        brought = []
        for output, files in outputs.items():
            if DONE not in files:
                continue  # it is being stored
            part = folder.root / UNITS / f".{output}.part"
            shutil.rmtree(part, ignore_errors=True)
            copies = {part / name: entry for name, entry in files.items()}
            check(copies)
            staging.fetch(self._storage, copies)
            target = folder.root / UNITS / output
            shutil.rmtree(target, ignore_errors=True)  # a part of one that was being removed
            part.rename(target)
            brought += [(f"{output}/{name}", entry.size) for name, entry in files.items()]
        return brought

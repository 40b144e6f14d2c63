"""Snapshots of a scene in tiles, for the live view of its job while the tiles are trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from splatmill_worker.pipeline.live import MOST_GAUSSIANS, Looks, most_covering, show_scene
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.report.export import ExportWorld
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.tiles import coarse_model
from splatmill_worker.tiles.cells import Cell
from splatmill_worker.tiles.folder import Ended, PlanFolder, facts_of
from splatmill_worker.tiles.units import seam_name, tile_name


@dataclass(frozen=True)
class _Part:
    """What is shown of a part of the scene.

    gaussians: without spherical harmonics; of many, those that cover the most.
    count: of all Gaussians of the part.
    """

    gaussians: Gaussians
    count: int


@dataclass(frozen=True)
class _Coarse:
    """What is shown of the coarse model.

    cells: of the tiles.
    parts: of each cell, and then of what no tile trains.
    """

    cells: tuple[Cell, ...]
    parts: tuple[_Part, ...]
    world: ExportWorld
    antialiased: bool


class LiveTiles:
    """Shows the tiles as they are trained, each in its cell, and the coarse model in the cells of the others."""

    def __init__(self, looks: Looks, folder: PlanFolder) -> None:
        self._looks, self._folder = looks, folder
        self._coarse: _Coarse | None = None
        self._trained: dict[int, tuple[Path, _Part]] = {}

    def look(self) -> None:
        """Show the scene by the tiles that have ended, if there is a coarse model, somebody looks, and it is time."""
        if self._looks.is_due() and "coarse" in (ended := self._folder.ended()):
            self.show(ended)

    def of_tile(self, number: int) -> LiveTile:
        """Observes the training of the tile `number`, from 0."""
        return LiveTile(self, self._folder, number)

    def is_due(self) -> bool:
        """Whether to show the scene now."""
        return self._looks.is_due()

    def show(self, ended: Mapping[str, Ended], number: int = -1, run: TrainingRun | None = None) -> None:
        """Show the scene. run: of the tile `number`, which is shown as it is."""
        with self._looks.one():
            path = ended["coarse"].path
            assert path is not None
            self._coarse = coarse = self._coarse or _read(path)
            facts, parts = [facts_of(path)], list(coarse.parts)
            for index, cell in enumerate(coarse.cells):
                outputs = _outputs(ended, index)
                facts += map(facts_of, outputs)
                if run is not None and index == number:
                    gaussians = gaussians_of(run.engine).padded(0)
                    inside = torch.from_numpy(cell.holds(gaussians.means.double().numpy()))
                    parts[index] = _part(gaussians.select(inside), 1 / len(coarse.cells))
                elif outputs:
                    parts[index] = self._part_of(index, outputs[-1])
            steps = sum(int(each["steps"]) for each in facts)
            seconds = sum(float(each.get("train_seconds", 0.0)) for each in facts)
            if run is not None:
                steps, seconds = steps + run.state.step, seconds + run.clock.seconds
            show_scene(
                self._looks.onlookers,
                concatenate(*(part.gaussians for part in parts)),
                coarse.world,
                count=sum(part.count for part in parts),
                antialiased=coarse.antialiased,
                step=steps,
                seconds=seconds,
            )

    def _part_of(self, index: int, output: Path) -> _Part:
        """What is shown of the tile `index` by the output of a unit, which is read once."""
        if self._trained.get(index, (None,))[0] != output:
            assert self._coarse is not None
            trained = coarse_model.read_gaussians(output)
            self._trained[index] = output, _part(trained, 1 / len(self._coarse.cells))
        return self._trained[index][1]


class LiveTile:
    """Observes the training of a tile, and shows the whole scene with the tile as it is."""

    def __init__(self, live: LiveTiles, folder: PlanFolder, number: int) -> None:
        self._live, self._folder, self._number = live, folder, number

    def is_due(self, run: TrainingRun) -> bool:
        """Whether to show the scene now."""
        return self._live.is_due()

    def observe(self, run: TrainingRun) -> None:
        """Show the scene as it is."""
        self._live.show(self._folder.ended(), self._number, run)


def _outputs(ended: Mapping[str, Ended], index: int) -> list[Path]:
    """The outputs of the units that have trained the tile `index`; none where it failed, whatever came after that."""
    units = ended.get(tile_name(index + 1)), ended.get(seam_name(index + 1))
    if units[0] is None or units[0].path is None:
        return []
    return [unit.path for unit in units if unit is not None and unit.path is not None]


def _part(gaussians: Gaussians, share: float) -> _Part:
    """What is shown of a part of the scene: at most twice so large a share of what is shown of all."""
    return _Part(most_covering(gaussians.padded(0), round(2 * share * MOST_GAUSSIANS)), gaussians.count)


def _read(path: Path) -> _Coarse:
    coarse = coarse_model.read(path)
    gaussians = coarse.gaussians.padded(0)
    means = gaussians.means.double().numpy()
    members = [torch.from_numpy(cell.holds(means)) & ~coarse.far for cell in coarse.cells]
    parts = [_part(gaussians.select(each), 1 / len(members)) for each in members]
    parts.append(_part(gaussians.select(coarse.far), 0.5))
    return _Coarse(coarse.cells, tuple(parts), coarse.world, coarse.plan.antialias)

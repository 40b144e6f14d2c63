"""The coarse model of a scene: what tiles start from and have as context, as the files of the unit `coarse`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report.export import ExportWorld
from splatmill_worker.splat.report.report import plain
from splatmill_worker.splat.train.disagreement import Disagreement
from splatmill_worker.splat.views import TrainingView
from splatmill_worker.tiles.cells import Cell
from splatmill_worker.tiles.photo_file import read_photos, write_photos

GAUSSIANS, FACTS, TRAINING, HELD_OUT = "gaussians.npz", "coarse.json", "training", "held-out"
OUTLIERS = "outliers.npz"


@dataclass(frozen=True)
class Coarse:
    """A coarse model, in the training world.

    gaussians: the Gaussians, of degree 3.
    plan: that they were trained by.
    cells: of the tiles.
    most: the largest number of Gaussians of the whole scene.
    steps: of its training.
    views: the training photos, in the light and with the cameras that the training left them.
    held_out: the photos that were not trained on.
    facts: what was measured before the training (`Facts.as_dict`).
    disagreements: how far the training photos disagree with one another.
    limited: whether a limit stopped the training from adding Gaussians (`Trained.limited`).
    world: of the exported model, without its frame.
    """

    gaussians: Gaussians
    plan: Plan
    cells: tuple[Cell, ...]
    most: int
    steps: int
    views: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]
    facts: dict[str, Any]
    disagreements: tuple[Disagreement, ...]
    limited: bool
    world: ExportWorld

    @cached_property
    def far(self) -> Tensor:
        """Which of the Gaussians no tile trains, bool [N] (see `far`)."""
        return far(self.gaussians, self.plan)

    def write(self, folder: Path) -> None:
        """Write the files into `folder`."""
        write_gaussians(folder, self.gaussians)
        write_photos(folder / TRAINING, self.views)
        write_photos(folder / HELD_OUT, self.held_out)
        with (folder / OUTLIERS).open("wb") as file:
            np.savez_compressed(file, *(each.outliers.numpy() for each in self.disagreements))
        document = {
            "plan": self.plan.as_dict(whole=True),
            "cells": [cell.as_dict() for cell in self.cells],
            "most": self.most,
            "steps": self.steps,
            "facts": plain(self.facts),
            "disagreements": [each[:-1] for each in self.disagreements],
            "limited": self.limited,
            "scale": self.world.normalization.scale,
            "translation": self.world.normalization.translation.tolist(),
            "offset": self.world.offset.tolist(),
        }
        atomic_write(folder / FACTS, json.dumps(document, indent=1))


def far(gaussians: Gaussians, plan: Plan) -> Tensor:
    """Which Gaussians of a coarse model no tile trains, bool [N].

    In a scene of which photos have less than half in view, these are all beyond half the distance to the far shell.
    Photos of all tiles show them, in particular through what the coarse training has not closed yet: a tile that had
    some of them would be trained on every photo of the scene (decisions: tile-steps). Where photos have half of the
    scene in view, every photo shows every tile anyway.
    """
    within = plan.schedule.decay_within
    if within is None or plan.schedule.in_view == 1.0:
        return torch.zeros(gaussians.count, dtype=torch.bool)
    distances: Tensor = gaussians.means.norm(dim=1)
    return distances >= within


def read(folder: Path) -> Coarse:
    """The model that `Coarse.write` left in `folder`. Raises OSError, ValueError or KeyError for other files."""
    document: dict[str, Any] = json.loads((folder / FACTS).read_text("utf-8"))
    return Coarse(
        read_gaussians(folder),
        Plan.from_dict(document["plan"]),
        tuple(Cell.from_dict(values) for values in document["cells"]),
        int(document["most"]),
        int(document["steps"]),
        read_photos(folder / TRAINING),
        read_photos(folder / HELD_OUT),
        document["facts"],
        _disagreements(folder, document["disagreements"]),
        bool(document["limited"]),
        ExportWorld(
            Normalization(float(document["scale"]), np.array(document["translation"], np.float64)),
            np.array(document["offset"], np.float64),
        ),
    )


def _disagreements(folder: Path, rows: list[list[Any]]) -> tuple[Disagreement, ...]:
    with np.load(folder / OUTLIERS, allow_pickle=False) as outliers:
        return tuple(
            Disagreement._make([*row, torch.from_numpy(outliers[f"arr_{index}"])])
            for index, row in enumerate(rows)
        )


def write_gaussians(folder: Path, gaussians: Gaussians) -> None:
    """Write Gaussians of the training world into `folder`, without loss."""
    arrays: dict[str, Any] = {name: value.numpy() for name, value in gaussians.parameters().items()}
    with (folder / GAUSSIANS).open("wb") as file:
        np.savez(file, **arrays)


def read_gaussians(folder: Path) -> Gaussians:
    """The Gaussians that `write_gaussians` left in `folder`."""
    with np.load(folder / GAUSSIANS, allow_pickle=False) as arrays:
        return Gaussians(**{name: torch.from_numpy(arrays[name]) for name in arrays.files})

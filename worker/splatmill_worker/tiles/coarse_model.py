"""The coarse model of a scene: what tiles start from and have as context, as the files of the unit `coarse`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.light import Light
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.tiles.cells import Cell

Float = npt.NDArray[np.float64]

GAUSSIANS, PHOTOS, FACTS = "gaussians.npz", "photos.npz", "coarse.json"


@dataclass(frozen=True)
class Coarse:
    """A coarse model, in the training world.

    gaussians: the Gaussians, of degree 3.
    plan: that they were trained by.
    cells: of the tiles.
    most: the largest number of Gaussians of the whole scene.
    steps: of its training.
    viewmats: world-to-camera matrices [4, 4] of the training photos as the training left them, by name.
    departures: logarithm of the exposure [3] of the training photos, by name; empty where their light stays as it is.
    """

    gaussians: Gaussians
    plan: Plan
    cells: tuple[Cell, ...]
    most: int
    steps: int
    viewmats: dict[str, Float]
    departures: dict[str, Float]

    @staticmethod
    def of(trained: Trained, plan: Plan, cells: list[Cell], most: int, light: Light | None) -> Coarse:
        """The model of a training run. light: of its photos, in their order; None where it stays as it is."""
        names = [view.name for view in trained.views]
        departures = {} if light is None else dict(zip(names, light.departures, strict=True))
        return Coarse(
            trained.gaussians.padded(3),
            plan,
            tuple(cells),
            most,
            trained.steps,
            {view.name: view.full.camera.viewmat for view in trained.views},
            departures,
        )

    @cached_property
    def far(self) -> Tensor:
        """Which of the Gaussians no tile trains, bool [N] (see `far`)."""
        return far(self.gaussians, self.plan)

    def corrected(self, name: str, camera: Camera) -> Camera:
        """The camera of a training photo as the coarse training left it."""
        return Camera(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, self.viewmats[name]
        )

    def write(self, folder: Path) -> None:
        """Write the files into `folder`."""
        write_gaussians(folder, self.gaussians)
        names = list(self.viewmats)
        with (folder / PHOTOS).open("wb") as file:
            np.savez(
                file,
                names=np.array(names),
                viewmats=np.array([self.viewmats[name] for name in names]),
                lit=np.array(list(self.departures), dtype=str),
                departures=np.array(list(self.departures.values()), np.float64).reshape(-1, 3),
            )
        document = {
            "plan": self.plan.as_dict(whole=True),
            "cells": [cell.as_dict() for cell in self.cells],
            "most": self.most,
            "steps": self.steps,
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
    with np.load(folder / PHOTOS, allow_pickle=False) as photos:
        viewmats = dict(zip(photos["names"].tolist(), photos["viewmats"], strict=True))
        departures = dict(zip(photos["lit"].tolist(), photos["departures"], strict=True))
    return Coarse(
        read_gaussians(folder),
        Plan.from_dict(document["plan"]),
        tuple(Cell.from_dict(values) for values in document["cells"]),
        int(document["most"]),
        int(document["steps"]),
        viewmats,
        departures,
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

"""The scenes of `bench stiffness`: real captures and the built-in still life, with photos of a hundred pixels or so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _data import FOLDERS, SHARED
from _train.configurations import revised

from splatmill.schema import TrainOptions
from splatmill_worker.images.load import Photo, load_views
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.holdout.split import split_views
from splatmill_worker.scene import Normalization, Scene, View
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import measure
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS, sample_frusta
from splatmill_worker.splat.start.points import ENOUGH_POINTS, from_points
from splatmill_worker.splat.start.seeding import add_seeds
from splatmill_worker.splat.views import TrainingView
from splatmill_worker.synthetic import orbit, photograph, still_life

STILL_LIFE = "synthetic"
POINTS = 4000
"""Points of the still life, from the true depths of its photos."""


@dataclass(frozen=True)
class Small:
    """A scene in the training world, ready to be planned.

    world: cameras and points. training, held_out: its photos. longest: longest side of the photos, pixels.
    """

    name: str
    world: Scene
    training: Sequence[TrainingView]
    held_out: Sequence[TrainingView]
    longest: int


def absence(name: str) -> str | None:
    """Why a scene cannot be had here, a sentence; None where it can."""
    if name == STILL_LIFE or (SHARED / FOLDERS[name]).is_dir():
        return None
    return f"{name} is left out: {FOLDERS[name]} is not in ../shared/data, and no part of the project."


def load(name: str, longest: int, work: Path, *, photos: int = 24) -> Small:
    """A scene with photos of `longest` pixels. Recovered cameras are kept in `work`, as those of `bench train` are.

    photos: number of photos of the still life; the others have those that they have.
    """
    options = TrainOptions(image_size=longest)
    if name == STILL_LIFE:
        scene, taken = _still_life(longest, photos)
    else:
        folder = work / name
        folder.mkdir(parents=True, exist_ok=True)
        scene = posed_scene(SHARED / FOLDERS[name], folder, options, lambda *_: None, lambda: False)
        taken = {}
    frame = Normalization.of(scene)

    def views(selection: Sequence[View]) -> list[TrainingView]:
        shot = [taken[view.name] for view in selection] if taken else load_views(selection, longest)
        return [TrainingView.of(photo, frame) for photo in shot]

    training, held_out = split_views(scene, options)
    return Small(name, frame.apply(scene), views(training), views(held_out), longest)


def planned(
    small: Small, steps: int, seed: int, changes: dict[str, Any], most: int | None = None
) -> tuple[Plan, Gaussians]:
    """The plan that the product makes for so many steps, with `changes` at dotted paths, and the first Gaussians.

    most: limit on the number of Gaussians; None: the plan's own. Light is not evened out between photos.
    """
    options = TrainOptions(image_size=small.longest, steps=steps, max_gaussians=most)
    first = _first(small, seed)
    facts, seeds = measure(small.world, small.training, len(small.held_out), None)
    plan = replace(revised(decide(facts, options, "cpu"), changes), seed=seed)
    gaussians = first.most_opaque(plan.max_gaussians)
    if plan.initial == "points":
        gaussians = add_seeds(
            gaussians,
            small.world,
            small.training,
            fill_gaps=plan.gaps,
            add_far_shell=plan.far_shell,
            max_gaussians=plan.max_gaussians,
            seeds=seeds,
        )
    return plan, gaussians


def _first(small: Small, seed: int) -> Gaussians:
    if len(small.world.points) >= ENOUGH_POINTS:
        return from_points(torch.from_numpy(small.world.points), torch.from_numpy(small.world.colors))
    return from_points(*sample_frusta([view.full for view in small.training], RANDOM_GAUSSIANS, seed))


@cache
def _still_life(longest: int, count: int) -> tuple[Scene, dict[str, Photo]]:
    """The still life with its true cameras, and its photos by name."""
    random = np.random.default_rng(0)
    life, views, photos, points, colors = still_life(0), [], {}, [], []
    for i, camera in enumerate(orbit(count, longest, longest * 3 // 4)):
        rgb, depth = photograph(life, camera, samples=1)
        view = View(f"{i:02d}.png", camera, Path(f"{i:02d}.png"))
        views.append(view)
        photos[view.name] = Photo(view, camera, rgb, None, None)
        rows, columns = (random.integers(size, size=POINTS // count) for size in rgb.shape[:2])
        near = depth[rows, columns] < 15.0  # what lies beyond is the background
        rows, columns = rows[near], columns[near]
        points.append(camera.unproject(columns + 0.5, rows + 0.5, depth[rows, columns]))
        colors.append(rgb[rows, columns])
    return Scene(tuple(views), np.concatenate(points), np.concatenate(colors), "transforms"), photos

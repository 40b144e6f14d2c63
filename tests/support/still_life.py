"""A tiny photographed scene with exact cameras and points, made once per test run."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatmill_worker.images.load import Photo
from splatmill_worker.scene import Camera, Normalization, Scene, View
from splatmill_worker.splat.views import TrainingView
from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.support.posed_sets import document

WIDTH, HEIGHT, COUNT = 96, 72, 14
POINTS = 1500


@cache
def pictures() -> tuple[tuple[Camera, np.ndarray, np.ndarray], ...]:
    """Camera, colour uint8 [H, W, 3] and depth [H, W] of every photo."""
    life = still_life(0)
    return tuple((camera, *photograph(life, camera, samples=1)) for camera in orbit(COUNT, WIDTH, HEIGHT))


@cache
def scene() -> Scene:
    """The posed scene, with points taken from the true depths of the photos."""
    random = np.random.default_rng(0)
    points, colors, views = [], [], []
    for i, (camera, rgb, depth) in enumerate(pictures()):
        views.append(View(f"{i:02d}.png", camera, Path(f"{i:02d}.png")))
        rows, columns = (
            random.integers(HEIGHT, size=POINTS // COUNT),
            random.integers(WIDTH, size=POINTS // COUNT),
        )
        z = depth[rows, columns]
        near = z < 15.0
        rows, columns, z = rows[near], columns[near], z[near]
        points.append(camera.unproject(columns + 0.5, rows + 0.5, z))
        colors.append(rgb[rows, columns])
    return Scene(tuple(views), np.concatenate(points), np.concatenate(colors), "transforms")


def training_views(alpha: bool = False) -> list[TrainingView]:
    """All photos in the training world; with `alpha`, what is farther than the table is transparent."""
    frame = Normalization.of(scene())
    views = []
    for view, (camera, rgb, depth) in zip(scene().views, pictures(), strict=True):
        cover = np.where(depth < 6.5, 255, 0).astype(np.uint8) if alpha else None
        views.append(TrainingView.of(Photo(view, camera, rgb.copy(), cover, None), frame))
    return views


def points() -> tuple[torch.Tensor, torch.Tensor]:
    """Points [M, 3] in the training world and colours uint8 [M, 3]."""
    world = Normalization.of(scene()).apply(scene())
    return torch.from_numpy(world.points), torch.from_numpy(world.colors)


def posed_capture(directory: Path, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Path:
    """A capture on disk: images/ and poses/transforms.json, in OpenGL axes as other tools write them, all moved."""
    (directory / "images").mkdir(parents=True)
    (directory / "poses").mkdir()
    for i, (_, rgb, _) in enumerate(pictures()):
        Image.fromarray(rgb).save(directory / "images" / f"{i:02d}.png")
    whole = document({f"{i:02d}.png": camera for i, (camera, _, _) in enumerate(pictures())})
    for frame in whole["frames"]:
        for axis in range(3):
            frame["transform_matrix"][axis][3] += offset[axis]
    (directory / "poses" / "transforms.json").write_text(json.dumps(whole))
    return directory

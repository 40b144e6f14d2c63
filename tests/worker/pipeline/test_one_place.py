"""Proves that photos from nearly one place are said to be so, with the figure, and that others are not.

Not proven here: how much the places seem to differ once cameras that only turned are recovered.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.pipeline.one_place import warning
from splatmill_worker.scene import Camera, Scene, View

DEPTH = 10.0


def scene(step: float, count: int = 5, points: int = 400) -> Scene:
    """Cameras that turn, with their places on a line `step` apart, amid points at the distance DEPTH."""
    views = []
    for k in range(count):
        c, s = np.cos(0.3 * k), np.sin(0.3 * k)
        matrix = np.eye(4)
        matrix[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        matrix[:3, 3] = -matrix[:3, :3] @ [step * k + 100.0, 0.0, 0.0]
        views.append(View(f"{k}.jpg", Camera(64, 48, 60.0, 60.0, 32.0, 24.0, matrix), Path(f"{k}.jpg")))
    directions = np.random.default_rng(0).normal(size=(points, 3))
    around = DEPTH * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    middle = [step * (count - 1) / 2 + 100.0, 0.0, 0.0]
    return Scene(tuple(views), around + middle, np.zeros((points, 3), np.uint8), "sfm")


@pytest.mark.parametrize(("step", "share"), [(0.0, "0.0%"), (0.05, "2.0%"), (0.12, "4.8%")])
def test_photos_from_nearly_one_place_are_said_with_the_figure(step: float, share: str) -> None:
    (said,) = warning(scene(step))
    assert said.startswith(f"All 5 photos were taken from nearly one place, {share} of the distance")


@pytest.mark.parametrize("step", [0.13, 0.5, 5.0])
def test_photos_from_different_places_are_not(step: float) -> None:
    assert warning(scene(step)) == []


def test_without_points_only_the_very_same_place_is_said() -> None:
    assert warning(scene(1e-4, points=0)) == []
    assert len(warning(scene(0.0, points=0))) == 1


def test_of_one_photo_nothing_is_said() -> None:
    assert warning(scene(0.0, count=1)) == []

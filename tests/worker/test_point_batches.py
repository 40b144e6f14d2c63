"""Proves that the batches near a camera hold every point that falls into its photo, and few of the others."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from splatmill_worker.point_batches import BATCH, PointBatches
from splatmill_worker.scene import Camera, viewmat_of


def cameras(count: int) -> list[Camera]:
    """Cameras at random places among the points, with principal points outside of the middle and of the photo."""
    random = np.random.default_rng(1)
    rotations = Rotation.random(count, random_state=random).as_matrix()
    centers = random.normal(0.0, 3.0, (count, 3))
    return [
        Camera(64, 48, 140.0, 155.0, *random.uniform(-30, 90, 2), viewmat_of(rotation, center))
        for rotation, center in zip(rotations, centers, strict=True)
    ]


def rows(points: np.ndarray) -> set[bytes]:
    return {point.tobytes() for point in points}


def test_no_point_in_a_photo_is_left_out_and_most_others_are() -> None:
    random = np.random.default_rng(0)
    known, points = PointBatches(), random.normal(0.0, 3.0, (20_000, 3))
    known.add(points[:19_000])
    for first in range(19_000, 20_000, 100):
        known.add(points[first : first + 100])
    shares = []
    for camera in cameras(40):
        near = known.near(camera)
        inside = points[camera.project(points).inside]
        assert rows(inside) <= rows(near) <= rows(points)
        assert len(near) == len(rows(near))
        shares.append(len(near) / len(points))
    assert np.median(shares) < 0.3


def test_points_that_are_not_finite_and_no_points_at_all_are_no_fault() -> None:
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    known = PointBatches()
    assert known.near(camera).shape == (0, 3)
    known.add(np.zeros((0, 3)))
    known.add(np.array([[np.nan, 0.0, 1.0], [0.0, 0.0, np.inf]]))
    assert known.near(camera).shape == (0, 3)
    known.add(np.tile([[0.0, 0.0, 2.0]], (BATCH + 1, 1)))
    assert len(known.near(camera)) == BATCH + 1

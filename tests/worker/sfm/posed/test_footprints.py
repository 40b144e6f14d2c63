"""Proves that points are thinned to the pixels that show them closest, and that nearer points hide farther ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Camera, Float, View
from splatmill_worker.sfm.posed.judged.footprints import footprints, resolved
from splatmill_worker.sfm.posed.judged.visible import visible

CAMERA = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4))


def view(camera: Camera) -> View:
    return View("a.png", camera, Path("a.png"))


def wall(depth: float, count: int, seed: int = 0) -> Float:
    """Random points on a wall across the camera's view, as large as the view is there."""
    half = 0.499 * depth
    random = np.random.default_rng(seed)
    across = random.uniform(-half, half, (count, 2))
    return np.column_stack([across, np.full(count, depth)])


def test_a_footprint_is_that_of_the_closest_photo_and_of_its_reduced_size() -> None:
    near = replace(CAMERA, viewmat=np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3.0], [0, 0, 0, 1]]))
    points = np.array([[0.0, 0, 4.0], [0.0, 0, 2.0], [0.0, 0, -1.0]])
    views = [view(CAMERA), view(near)]
    assert footprints(points, views, None).tolist() == pytest.approx([0.01, 0.02, np.inf])
    assert footprints(points, views, 50).tolist() == pytest.approx([0.02, 0.04, np.inf])
    assert footprints(points, views, 400).tolist() == pytest.approx([0.01, 0.02, np.inf])  # none is enlarged


@pytest.mark.parametrize("depth", [2.56, 2560.0])
def test_one_point_stays_for_each_pixel(depth: float) -> None:
    points = wall(depth, 200_000)
    sizes = footprints(points, [view(CAMERA)], None)
    rows, pixels = resolved(points, sizes, 100_000)
    assert pixels == 1.0
    # The wall has 99.8 x 99.8 pixels; cells are 0.7 to 1.4 of one wide.
    assert 0.45 * 99.8**2 < len(rows) < 2.1 * 101**2
    assert len(np.unique(rows)) == len(rows)


def test_cells_grow_where_too_many_would_stay_and_a_part_is_spread_as_all_are() -> None:
    points = wall(2.56, 200_000)
    sizes = footprints(points, [view(CAMERA)], None)
    rows, pixels = resolved(points, sizes, 1000)
    assert 400 < len(rows) <= 1000
    assert pixels > 2.0
    part = points[rows[: len(rows) // 4], :2]
    assert np.abs(part.mean(axis=0)).max() < 0.15
    quadrants = np.unique((part > 0) @ [1, 2], return_counts=True)[1]
    assert quadrants.min() > 0.5 * quadrants.mean()


def test_points_that_no_photo_shows_are_left_out() -> None:
    points = np.array([[0.0, 0, 2.0], [0.0, 0, -2.0], [np.nan, 0, 2.0], [0.0, 0, 2.0]])
    rows, _ = resolved(points, footprints(points, [view(CAMERA)], None), 10)
    assert len(rows) == 1
    assert rows[0] in (0, 3)
    assert len(resolved(points[1:2], np.array([np.inf]), 10)[0]) == 0


def test_a_wall_hides_what_lies_behind_it() -> None:
    front, behind = wall(2.0, 4000), wall(3.0, 4000, seed=1)
    points = np.concatenate([front, behind])
    rows = visible(CAMERA, CAMERA.project(points))
    assert (rows < len(front)).sum() == len(front)
    assert (rows >= len(front)).sum() < 0.1 * len(behind)


def test_a_slanted_surface_does_not_hide_itself() -> None:
    points = wall(2.0, 4000)
    points[:, 2] += points[:, 0]  # 45 degrees
    projection = CAMERA.project(points)
    assert len(visible(CAMERA, projection)) == projection.inside.sum()

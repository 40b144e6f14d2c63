"""Proves what the cells of a coarse photo hold, and which points a view shows.

Does not prove that 48 cells are the best number.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatmill_worker.splat.start.cells import Cells, projected, visible_points
from tests.support.scenes.street import BRICK, right_half, street
from tests.support.training import sparse_scene


def test_cells_are_covered_by_points_and_their_neighbours() -> None:
    grid = Cells.of(street(), np.array([[0.0, 0.5, 2.0], [0.0, 0.0, -1.0]]))
    assert grid.color.shape == (32, 48, 3)
    assert len(grid.points) == 1
    assert grid.covered.sum() == 9
    column, row, depth = grid.points[0]
    assert (column, row, depth) == pytest.approx((24.0, 26.0, 2.0))
    assert grid.covered[26, 24]


def test_unprojected_cells_project_to_their_centres() -> None:
    grid = Cells.of(street(0.7), np.empty((0, 3)))
    places = grid.unproject(np.array([[3, 40], [20, 1]]), np.array([5.0, 2.0]))
    assert projected(grid.camera, places) == pytest.approx(np.array([[40.5, 3.5, 5.0], [1.5, 20.5, 2.0]]))


def test_masked_pixels_do_not_count_in_colour_and_use() -> None:
    mask = right_half()
    mask[:, 48:52] = False
    view = street(mask=mask)
    view.full.rgb[:, :52] = 255
    grid = Cells.of(view, np.empty((0, 3)))
    assert not grid.used[:, :26].any()
    assert grid.used[:, 26:].all()
    assert (grid.color[16:, 26:] == BRICK).all()


def test_views_have_the_points_of_their_tracks_or_all_of_them() -> None:
    world, views = sparse_scene()
    clouds = visible_points(world, views)
    assert world.point_views is not None
    assert sum(map(len, clouds)) == len(world.point_views.views)
    for view, points in zip(views, clouds, strict=True):
        assert view.full.camera.project(points).inside.all()
    untracked = replace(world, point_views=None)
    assert all(len(points) == len(world.points) for points in visible_points(untracked, views))

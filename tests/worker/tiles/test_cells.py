"""Cells hold every point once, in about equal parts by weight, whatever the points are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatmill_worker.tiles.cells import Cell, divide


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 9),
    size=st.integers(0, 60),
    spread=st.sampled_from([0, 1, 3]),
)
def test_every_point_is_in_one_cell(seed: int, count: int, size: int, spread: int) -> None:
    random = np.random.default_rng(seed)
    points = np.round(random.normal(size=(size, 3)) * spread, 0)  # many coincide along an axis, or altogether
    cells = divide(points, random.random(size), count)
    assert 1 <= len(cells) <= count
    assert (np.sum([cell.holds(points) for cell in cells], axis=0) == 1).all()
    anywhere = random.normal(size=(50, 3)) * 1e6  # far from all points, as what training moves there
    assert (np.sum([cell.holds(anywhere) for cell in cells], axis=0) == 1).all()


@pytest.mark.parametrize("count", [2, 3, 4, 7, 16])
def test_cells_have_about_the_same_weight(count: int) -> None:
    random = np.random.default_rng(count)
    points = random.lognormal(size=(5000, 3)) * np.array([30.0, 10.0, 1.0])
    weights = random.random(5000)
    shares = [weights[cell.holds(points)].sum() / weights.sum() for cell in divide(points, weights, count)]
    assert len(shares) == count
    assert max(shares) <= 2.0 / count + 0.01
    assert min(shares) >= 0.5 / count - 0.01


def test_a_street_is_divided_across_its_length_and_a_far_point_changes_that_little() -> None:
    random = np.random.default_rng(0)
    points = random.random((1000, 3)) * np.array([1.0, 1.0, 40.0])
    points[0] = 1e5, 0.5, 20.0
    cells = divide(points, np.ones(1000), 4)
    cuts = sorted({cell.high[2] for cell in cells if np.isfinite(cell.high[2])})
    assert cuts == pytest.approx([10.0, 20.0, 30.0], abs=1.5)
    assert all(np.isinf(cell.low[:2]).all() for cell in cells)


def test_points_in_one_place_are_one_cell() -> None:
    assert len(divide(np.ones((10, 3)), np.ones(10), 4)) == 1
    assert len(divide(np.zeros((0, 3)), np.zeros(0), 4)) == 1
    two = np.repeat([[0.0, 0, 0], [1.0, 0, 0]], [9, 1], axis=0)
    assert len(divide(two, np.ones(10), 4)) == 2


def test_a_margin_widens_a_cell_on_each_side_and_corners_survive_json() -> None:
    cell = Cell(np.array([0.0, -np.inf, -np.inf]), np.array([1.0, np.inf, 2.0]))
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.1, 0, 0], [0.5, 9, 2.05], [0.5, 9, 2.2]])
    assert cell.holds(points).tolist() == [True, False, False, False, False]
    assert cell.holds(points, 0.1).tolist() == [True, True, True, True, False]
    again = Cell.from_dict(cell.as_dict())
    assert again.low.tolist() == cell.low.tolist()
    assert again.high.tolist() == cell.high.tolist()


def test_cells_touch_that_share_a_side() -> None:
    points = np.random.default_rng(0).uniform(size=(4000, 3)) * [8.0, 1.0, 1.0]
    cells = sorted(divide(points, np.ones(len(points)), 4), key=lambda cell: cell.low[0])
    touching = {(a, b) for a in range(4) for b in range(4) if cells[a].touches(cells[b])}
    assert touching == {(a, b) for a in range(4) for b in range(4) if abs(a - b) <= 1}

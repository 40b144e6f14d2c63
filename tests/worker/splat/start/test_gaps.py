"""Proves which cells are gaps, and where the Gaussians that fill them are put.

Does not prove that this pays on real photos: `splatmill bench train --configs no-gaps` measures that.
"""

from __future__ import annotations

import numpy as np
import pytest

from splatmill_worker.splat.start.cells import Cells
from splatmill_worker.splat.start.gaps import gap_points, gap_share
from tests.support.scenes.street import BRICK, right_half, street


def test_gaps_are_cells_without_sky_and_without_points() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 2.0]])
    grid = Cells.of(street(), points)
    assert gap_share([grid]) == pytest.approx(1.0 - 27 / (16 * 48))
    places, colors = gap_points([grid])
    assert len(places) == 16 * 48 - 27
    assert places[:, 2] == pytest.approx(2.0)
    assert (colors == BRICK).all()


def test_a_second_photo_of_the_same_place_adds_only_what_the_first_does_not_show() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 2.0]])
    first, second = Cells.of(street(0.0), points), Cells.of(street(0.5), points)
    alone, both = len(gap_points([first])[0]), len(gap_points([first, second])[0])
    new = both - alone
    assert 0.2 * alone < new < 0.5 * alone  # half a unit at depth 2 is 10 of 48 columns
    assert len(gap_points([first, first])[0]) == alone


def test_masked_cells_are_no_gaps() -> None:
    points = np.array([[0.2, 0.3, 2.0], [0.3, 0.3, 2.0], [0.5, 0.3, 2.0]])
    places, _ = gap_points([Cells.of(street(mask=right_half()), points)])
    assert len(places)
    assert float(places[:, 0].min()) > 0.0


def test_the_depth_of_a_gap_is_the_mean_inverse_depth_of_its_neighbours() -> None:
    points = np.array([[0.0, 0.1, 1.0], [0.0, 0.4, 2.0], [0.0, 1.2, 4.0]])
    places, _ = gap_points([Cells.of(street(), points)])
    assert len(places)
    assert places[:, 2] == pytest.approx(3.0 / (1.0 + 0.5 + 0.25))


def test_a_photo_with_fewer_than_three_points_gets_none() -> None:
    assert len(gap_points([Cells.of(street(), np.array([[0.0, 0.1, 1.0], [0.0, 0.4, 2.0]]))])[0]) == 0

"""Proves that the far shell lies far behind the scene, wherever photos look, in the colours that they show.

Does not prove that it pays on real photos: `splatmill bench train --configs no-far-shell` measures that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from splatmill_worker.splat.start import far_shell
from splatmill_worker.splat.start.cells import Cells
from splatmill_worker.splat.views import TrainingView
from tests.support.scenes.street import BLUE, BRICK, right_half, street


def test_the_shell_is_far_and_wherever_photos_look() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 4.0]])
    grids = [Cells.of(street(x), points) for x in (-0.2, 0.0, 0.2)]
    places, colors = far_shell.shell_points(grids, points)
    distance = np.linalg.norm(places, axis=1)
    assert distance.min() > 0.99 * far_shell.DISTANCE * 3.0
    assert distance.max() / distance.min() < 1.01
    for grid in grids:
        columns, rows, _, inside = grid.camera.project(places)
        assert inside.sum() > 0.7 * 16 * 24
        up, down = rows < 14, rows > 18
        assert (colors[up] == BLUE).all()
        assert (colors[down] == BRICK).all()
        # Beyond the borders too, by a few cells.
        assert -far_shell.BORDER_CELLS - 2 < columns.min() < -3
        assert 48 + 3 < columns.max() < 48 + far_shell.BORDER_CELLS + 2


def test_what_a_photo_shows_outweighs_the_extension_of_another() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 4.0]])
    first = street()
    # From the first one's middle to half a photo past its right border.
    beside = replace(first.full.camera, cx=0.0)
    grey = first.full._replace(camera=beside, rgb=torch.full_like(first.full.rgb, 200))
    grids = [Cells.of(first, points), Cells.of(TrainingView("beside", {1: grey}), points)]
    places, colors = far_shell.shell_points(grids, points)
    columns, rows, _, _ = grids[0].camera.project(places)
    lower = rows > 18
    left = lower & (columns > 19) & (columns < 20.5)
    right = lower & (columns > 50) & (columns < 53)
    assert left.any()
    assert right.any()
    assert np.abs(np.median(colors[left], axis=0) - BRICK).max() < 10
    assert np.abs(np.median(colors[right], axis=0) - 200).max() < 10


def test_masked_cells_leave_no_colour_on_the_shell() -> None:
    points = np.array([[0.2, 0.3, 2.0], [0.3, 0.3, 2.0], [0.5, 0.3, 2.0]])
    grid = Cells.of(street(mask=right_half()), points)
    assert grid.camera.project(far_shell.shell_points([grid], points)[0]).columns.min() > 23
    masked = Cells.of(street(mask=torch.zeros_like(right_half())), points)
    places, colors = far_shell.shell_points([masked], points)
    assert places.shape == colors.shape == (0, 3)

"""Proves where Gaussians are put for what the points leave open: gaps as deep as their neighbours, a shell far away.

Does not prove that this pays on real photos: `bench train --configs` measures that. Which colours are sky is a
rule, and is proven here on plain cases only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.start import far_shell, gaps, seeding, sky
from splatmill_worker.splat.start.cells import Cells, cells_of, projected
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.views import Target, TrainingView
from tests.support.training import sparse_scene

BLUE, BRICK, CLOUD = (90, 140, 230), (140, 80, 60), (215, 218, 225)


def camera(x: float = 0.0) -> Camera:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(96, 64, 80.0, 80.0, 48.0, 32.0, viewmat)


def street(x: float = 0.0, mask: torch.Tensor | None = None) -> TrainingView:
    """Blue above, brick below."""
    rgb = torch.zeros(64, 96, 3, dtype=torch.uint8)
    rgb[:32] = torch.tensor(BLUE, dtype=torch.uint8)
    rgb[32:] = torch.tensor(BRICK, dtype=torch.uint8)
    seen = camera(x)
    target = Target(seen, torch.eye(4), torch.as_tensor(seen.K), rgb, None, mask)
    return TrainingView(f"{x}", {1: target})


def test_cells_are_covered_by_points_and_their_neighbours() -> None:
    grid = Cells.of(street(), np.array([[0.0, 0.5, 2.0], [0.0, 0.0, -1.0]]))
    assert grid.color.shape == (32, 48, 3)
    assert len(grid.points) == 1
    assert grid.covered.sum() == 9
    column, row, depth = grid.points[0]
    assert (column, row, depth) == pytest.approx((24.0, 26.0, 2.0))
    assert grid.covered[26, 24]


def test_cells_point_back_to_where_they_came_from() -> None:
    grid = Cells.of(street(0.7), np.empty((0, 3)))
    places = grid.unproject(np.array([[3, 40], [20, 1]]), np.array([5.0, 2.0]))
    assert projected(grid.camera, places) == pytest.approx(np.array([[40.5, 3.5, 5.0], [1.5, 20.5, 2.0]]))


def test_gaps_are_filled_at_the_inverse_depth_of_their_neighbours() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 2.0]])
    grid = Cells.of(street(), points)
    assert gaps.gap_share([grid]) == pytest.approx(1.0 - 27 / (16 * 48))
    places, colors = gaps.gap_points([grid])
    assert len(places) == 16 * 48 - 27
    assert places[:, 2] == pytest.approx(2.0)
    assert (colors == BRICK).all()


def test_a_second_photo_of_the_same_place_adds_only_what_it_alone_shows() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 2.0]])
    first, second = Cells.of(street(0.0), points), Cells.of(street(0.5), points)
    alone, both = len(gaps.gap_points([first])[0]), len(gaps.gap_points([first, second])[0])
    new = both - alone
    assert 0.2 * alone < new < 0.5 * alone  # half a unit at depth 2 is 10 of 48 columns
    assert len(gaps.gap_points([first, first])[0]) == alone


def test_masked_cells_are_no_gaps() -> None:
    mask = torch.ones(64, 96, dtype=torch.bool)
    mask[:, :48] = False
    points = np.array([[0.2, 0.3, 2.0], [0.3, 0.3, 2.0], [0.5, 0.3, 2.0]])
    places, _ = gaps.gap_points([Cells.of(street(mask=mask), points)])
    assert len(places)
    assert float(places[:, 0].min()) > 0.0


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([BLUE, CLOUD, BRICK, BLUE], [True, True, False, False]),
        ([BRICK, BLUE, BLUE, BLUE], [False] * 4),
        ([(20, 30, 60), CLOUD, CLOUD, CLOUD], [False] * 4),
        ([(250, 250, 200), CLOUD, CLOUD, CLOUD], [False] * 4),
    ],
)
def test_the_sky_is_blue_or_grey_and_has_nothing_above_it(
    rows: list[tuple[int, int, int]], expected: list[bool]
) -> None:
    assert (
        sky.sky_of(np.array(rows, np.uint8)[:, None], np.ones((len(rows), 1), bool)).ravel().tolist()
        == expected
    )


def test_the_shell_is_far_and_wherever_photos_look() -> None:
    points = np.array([[-0.5, 0.3, 2.0], [0.0, 0.3, 2.0], [0.5, 0.3, 4.0]])
    grids = [Cells.of(street(x), points) for x in (-0.2, 0.0, 0.2)]
    assert sky.sky_share(grids) == pytest.approx(0.5)
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


def test_what_a_photo_shows_outweighs_what_another_continues() -> None:
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
    mask = torch.ones(64, 96, dtype=torch.bool)
    mask[:, :48] = False
    points = np.array([[0.2, 0.3, 2.0], [0.3, 0.3, 2.0], [0.5, 0.3, 2.0]])
    grid = Cells.of(street(mask=mask), points)
    assert grid.camera.project(far_shell.shell_points([grid], points)[0]).columns.min() > 23
    masked = Cells.of(street(mask=torch.zeros(64, 96, dtype=torch.bool)), points)
    places, colors = far_shell.shell_points([masked], points)
    assert places.shape == colors.shape == (0, 3)


def test_what_is_added_keeps_to_the_limit_and_to_what_the_plan_says() -> None:
    world, views = sparse_scene()
    first = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))
    nothing = seeding.add_seeds(
        first, world, views, fill_gaps=False, add_far_shell=False, max_gaussians=10**6
    )
    assert nothing is first
    wanted = len(gaps.gap_points(cells_of(world, views))[0])
    whole = seeding.add_seeds(first, world, views, fill_gaps=True, add_far_shell=False, max_gaussians=10**6)
    assert whole.count == first.count + wanted
    assert bool(whole.finite().all())
    most = first.count + 10
    limited = seeding.add_seeds(first, world, views, fill_gaps=True, add_far_shell=True, max_gaussians=most)
    assert limited.count == most

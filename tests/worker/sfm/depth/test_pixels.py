"""Proves that pixels of depth maps look along the rays of their photos, with and without a lens, and which count."""

import numpy as np
import pytest

from splatmill_worker.scene import Camera, Lens, View, viewmat_of
from splatmill_worker.sfm.depth.pixels import DepthMap, highest, without_edges
from tests.support.paths import ROOT

POSE = viewmat_of(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, -2.0, 0.5]))
LENSES = {
    "pinhole": None,
    "OPENCV": Lens("OPENCV", (600.0, 610.0, 310.0, 250.0, -0.1, 0.02, 1e-3, -2e-3), 640, 480),
    "OPENCV_FISHEYE": Lens("OPENCV_FISHEYE", (400.0, 400.0, 320.0, 240.0, 0.03, -0.01, 0.0, 0.0), 640, 480),
}


@pytest.mark.parametrize("lens", LENSES)
def test_points_of_pixels_fall_on_these_pixels(lens: str) -> None:
    """The map has another size than the photo."""
    view = View("a", Camera(640, 480, 600.0, 610.0, 310.0, 250.0, POSE), ROOT, lens=LENSES[lens])
    rows, columns = (each.ravel() for each in np.mgrid[:48, :64])
    levels = (2.0 + 0.01 * columns + 0.02 * rows).astype(np.float32).reshape(48, 64)
    depth = DepthMap(0, levels, np.ones((48, 64), bool))
    local = depth.local(view, rows, columns) * levels.ravel()[:, None].astype(np.float64)
    world = view.camera.to_world(local)
    assert world.dtype == np.float64
    order, depths, there = depth.at(view, world)
    np.testing.assert_array_equal(order, np.arange(len(world)))
    np.testing.assert_allclose(depths, levels.ravel(), rtol=1e-6)
    np.testing.assert_allclose(there, levels.ravel(), rtol=1e-6)
    if LENSES[lens] is None:
        middle = view.camera.project(world)
        np.testing.assert_allclose(middle.columns, 10.0 * (columns + 0.5), atol=1e-6)
        np.testing.assert_allclose(middle.rows, 10.0 * (rows + 0.5), atol=1e-6)


def test_both_sides_of_an_edge_are_left_out() -> None:
    levels = np.full((4, 6), 1000.0, np.float32)
    levels[:, 3:] = 1100.0
    levels[0, 0] = 0.0
    expected = np.ones((4, 6), bool)
    expected[:, 2:4] = False
    expected[0, 0] = False
    np.testing.assert_array_equal(without_edges(levels), expected)
    levels[:, 3:] = 1040.0
    assert without_edges(levels).sum() == 23


@pytest.mark.parametrize(
    ("levels", "most", "few", "counting"),
    [
        ([0, 1, 2], 2, True, [2]),
        ([0, 54, 255], 255, True, [255]),
        ([0, 0, 0], 0, True, []),
        ([0, 100, 130, 200, 255], 255, False, [130, 200, 255]),
    ],
)
def test_the_highest_confidence_counts(levels: list[int], most: int, few: bool, counting: list[int]) -> None:
    array = np.array([levels], np.uint8)
    assert array[highest(array, most, few)].tolist() == counting

"""Proves that a scan is brought onto the points of a scene by the similarity that it was moved with, whatever that is.

The scan is simulated on the still life: true surfaces with the noise of a scanner's ranges and holes. Does not prove
that a wrong alignment is noticed: the photos judge it (`tests/worker/pipeline/test_scan_fit.py`).
"""

from functools import cache

import numpy as np
import pytest

from splatmill_worker import synthetic
from splatmill_worker.scene import Float, Similarity
from splatmill_worker.sfm.alignment import Aligned, Unaligned, align
from splatmill_worker.sfm.alignment.cells import in_cells, spread
from tests.support import still_life

pytestmark = pytest.mark.slow

UTM = np.array([500_000.0, 5_400_000.0, 300.0])


@cache
def scanned() -> tuple[Float, np.ndarray]:
    return synthetic.scan(120, 90)


def moved(seed: int, scale: float = 1.0, offset: Float = UTM) -> Similarity:
    """A random rotation, a scale and an offset."""
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return Similarity(rotation * np.sign(np.linalg.det(rotation)), scale, offset)


def error(alignment: Aligned, truth: Similarity, points: Float) -> float:
    """Median distance of the points from where they belong, once moved there and back."""
    apart = alignment.similarity.points(truth.points(points)) - points
    return float(np.median(np.linalg.norm(apart, axis=1)))


@pytest.mark.parametrize(("seed", "scale"), [(1, 1.0), (2, 1000.0), (3, 0.02)])
def test_a_scan_in_any_unit_and_place_is_brought_back(seed: int, scale: float) -> None:
    points, colors = scanned()
    truth = moved(seed, scale)
    own = still_life.scene()
    told: list[tuple[str, int, int, str]] = []
    alignment = align(
        truth.points(points), colors, own.points, own.colors, on_progress=lambda *report: told.append(report)
    )
    assert isinstance(alignment, Aligned)
    # Points of the scene have a median distance of 1.6 from their middle.
    assert error(alignment, truth, own.points) < 0.01
    assert [report[:2] for report in told] == [("alignment", done) for done in range(len(told))]
    assert 0 < len(told) <= told[0][2]
    assert alignment.similarity.scale * scale == pytest.approx(1.0, rel=0.005)
    assert alignment.share > 0.5
    # Noise of 0.004 and the planes through points that are 0.03 apart.
    assert 0.001 < alignment.residual / scale < 0.03


def test_duplicates_change_nothing_about_the_place() -> None:
    points, colors = scanned()
    truth = moved(4, 3.0)
    own = still_life.scene()
    twice = np.concatenate([truth.points(points)] * 2)
    alignment = align(twice, np.concatenate([colors] * 2), own.points, own.colors)
    assert isinstance(alignment, Aligned)
    assert error(alignment, truth, own.points) < 0.01


def test_a_point_at_the_end_of_the_world_changes_nothing() -> None:
    points, colors = scanned()
    own = still_life.scene()
    points, colors = points.copy(), colors.copy()
    points[7] = 1e200
    alignment = align(points, colors, own.points, own.colors)
    assert isinstance(alignment, Aligned)
    assert error(alignment, Similarity(np.eye(3), 1.0, np.zeros(3)), own.points) < 0.01


def test_a_scan_of_a_part_of_the_scene_is_brought_back() -> None:
    points, colors = synthetic.scan(240, 180)
    near = np.linalg.norm(points - np.array([0.0, 0.0, 0.4]), axis=1)
    part = near < np.quantile(near, 0.15)
    truth = moved(5, 7.0)
    own = still_life.scene()
    alignment = align(truth.points(points[part]), colors[part], own.points, own.colors)
    assert isinstance(alignment, Aligned)
    there = np.linalg.norm(own.points - np.array([0.0, 0.0, 0.4]), axis=1) < near[part].max()
    assert there.mean() < 0.4
    assert error(alignment, truth, own.points[there]) < 0.05


def test_a_scan_of_a_house_around_the_scene_is_brought_back() -> None:
    points, colors = synthetic.scan(240, 180)
    random = np.random.default_rng(0)
    walls = random.uniform(-8.0, 8.0, (20_000, 3))
    axis = random.integers(0, 3, len(walls))
    walls[np.arange(len(walls)), axis] = np.where(random.random(len(walls)) < 0.5, -8.0, 8.0)
    paint = random.integers(0, 255, (300, 3))
    patches = paint[np.abs((walls // 2).astype(int) @ np.array([1, 20, 400])) % 300].astype(np.uint8)
    truth = moved(6, 1.0)
    own = still_life.scene()
    alignment = align(
        truth.points(np.concatenate([points, walls])),
        np.concatenate([colors, patches]),
        own.points,
        own.colors,
    )
    assert isinstance(alignment, Aligned)
    assert error(alignment, truth, own.points) < 0.1


def line(count: int) -> Float:
    return np.outer(np.linspace(0, 1, count), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((1, 3)), "it has 1 distinct points"),
        (np.ones((500, 3)), "it has 1 distinct points"),
        (line(500), "all of its points lie on a line"),
    ],
)
def test_points_that_determine_no_similarity_are_named(points: Float, reason: str) -> None:
    own = still_life.scene()
    outcome = align(points, np.full((len(points), 3), 90, np.uint8), own.points, own.colors)
    assert outcome == Unaligned(f"of the file, {reason}")


def test_a_scene_without_points_is_named() -> None:
    points, colors = scanned()
    outcome = align(points, colors, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert outcome == Unaligned("of the cloud of the photos, it has 0 distinct points")


def test_a_scan_of_a_plane_alone_is_brought_back() -> None:
    points, colors = scanned()
    flat = (np.abs(points[:, 2] - np.median(points[:, 2])) < 0.02) & (np.linalg.norm(points, axis=1) < 2.0)
    plane = points[flat] * [1, 1, 0] + [0, 0, np.median(points[:, 2])]
    truth = moved(7, 2.0, np.zeros(3))
    own = still_life.scene()
    outcome = align(truth.points(plane), colors[flat], own.points, own.colors)
    if isinstance(outcome, Aligned):
        assert error(outcome, truth, plane) < 0.05


def test_the_same_scan_gives_the_same_similarity() -> None:
    points, colors = scanned()[0][::3], scanned()[1][::3]
    own = still_life.scene()
    one, other = (align(points, colors, own.points, own.colors, seed=3) for _ in range(2))
    assert isinstance(one, Aligned)
    assert isinstance(other, Aligned)
    np.testing.assert_array_equal(one.similarity.matrix, other.similarity.matrix)


def test_places_that_fit_equally_well_are_told_apart() -> None:
    """Colours exchanged: no place is right, and many hold the same few points of the scene."""
    points, colors = scanned()[0][::40], scanned()[1][::40]
    own = still_life.scene()
    exchanged = np.random.default_rng(1).permutation(len(colors))
    alignment = align(points, colors[exchanged], own.points[::20], own.colors[::20])
    assert isinstance(alignment, Aligned)
    assert alignment.share < 0.5


def test_cells_hold_one_point_each() -> None:
    points = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [1.1, 0, 0]])
    assert in_cells(points, 1.0).tolist() == [0, 3]
    assert in_cells(points, 0.0).tolist() == [0, 1, 2, 3]
    assert in_cells(points, np.array([1.0, 1.0, 1.0, 0.5, 0.5])).tolist() == [0, 3]
    many = np.random.default_rng(0).uniform(0, 1, (20_000, 3))
    assert 800 < len(spread(many, 1000)) <= 1000

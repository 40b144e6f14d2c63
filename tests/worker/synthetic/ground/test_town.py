"""The generated ground is ground truth: depths are those of its solids, views agree, and a seed fixes the bytes.

Does not prove that it looks like a town, nor that its textures are easy or hard to match.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.synthetic.ground import Flight, Town, capture, depths, photograph
from splatmill_worker.synthetic.ground.paint import BLOCK
from splatmill_worker.synthetic.ground.solids import Ball, Hull, Solid

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def town() -> Town:
    return Town(0)


def met(solid: Solid, eye: np.ndarray, ray: np.ndarray) -> float:
    """Depth along eye + depth * ray of a solid, one ray at a time in double precision; infinity where it passes by."""
    if isinstance(solid, Ball):
        place, ray = (eye - solid.center) / solid.radii, ray / solid.radii
        a, b, c = ray @ ray, place @ ray, place @ place - 1.0
        return float(-b - math.sqrt(b * b - a * c)) / float(a) if b * b > a * c and b < 0 else math.inf
    near, far = -math.inf, math.inf
    for normal, limit in zip(solid.normals, solid.limits, strict=True):
        reach = (limit - normal @ eye) / (normal @ ray)
        if normal @ ray < 0:
            near = max(near, reach)
        else:
            far = min(far, reach)
    return float(near) if 0 < near < far else math.inf


def around(town: Town, camera: Camera) -> list[Solid]:
    """The solids of all blocks within 100 metres of the camera."""
    east, north = (round(float(c) / BLOCK) for c in camera.center[:2])
    return [s for e in range(-3, 3) for n in range(-3, 3) for s in town.block(east + e, north + n).solids]


def test_depths_are_those_of_the_nearest_solid_or_of_the_ground(town: Town) -> None:
    camera = Flight().cameras(30, 64, 48, 0)[7]
    depth = depths(town, camera)
    solids = around(town, camera)
    corners = np.array([(s.lowest, s.highest) for s in solids])
    middles, reaches = corners.mean(1), np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1) / 2
    on_solids = 0
    for row, column in np.random.default_rng(0).integers([48, 64], size=(100, 2)):
        x, y = camera.normalized(column + 0.5, row + 0.5)
        ray = np.array([x, y, 1.0]) @ camera.viewmat[:3, :3]
        ground = -camera.center[2] / ray[2]
        apart = np.linalg.norm(np.cross(middles - camera.center, ray / np.linalg.norm(ray)), axis=1)
        hits = [
            (met(solids[k], camera.center, ray), isinstance(solids[k], Ball))
            for k in np.flatnonzero(apart <= reaches)
        ]
        expected, on_ball = min([(ground, False), *hits])
        on_solids += expected < ground
        # A ball is met at the root of a small difference of squares, in single precision.
        error = 0.01 if on_ball else 1e-5 * expected
        assert depth[row, column] == pytest.approx(expected, abs=error), (row, column)
    assert on_solids > 20


def test_the_middle_of_a_roof_projects_to_the_pixel_that_is_as_far_away(town: Town) -> None:
    camera = Flight(drift=0.0, sway=0.0).cameras(30, 320, 240, 0)[7]
    depth = depths(town, camera)
    tops = [
        ((np.array(s.lowest) + s.highest) / 2 * [1, 1, 0] + [0, 0, s.highest[2]])
        for s in around(town, camera)
        if isinstance(s, Hull) and len(s.normals) == 6 and s.highest[2] < 1.5  # of cabins of cars
    ]
    columns, rows, distance, inside = camera.project(np.array(tops))
    assert inside.sum() > 10
    pixel_depths = depth[rows[inside].astype(int), columns[inside].astype(int)]
    # Half a pixel of a level roof, seen 45 degrees from straight down at most, is as deep as it is wide.
    near = np.abs(pixel_depths - distance[inside]) < 0.5 * distance[inside] / camera.fx
    nearer = pixel_depths < distance[inside]  # a crown or a cabin hides some
    assert near.mean() > 0.3
    assert (near | nearer).all()


def test_two_views_of_the_bare_ground_agree(town: Town) -> None:
    first, second = Flight().cameras(30, 320, 240, 0)[7:9]
    depth = depths(town, first).astype(np.float64)
    column, row = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    points = first.unproject(column.ravel(), row.ravel(), depth.ravel())
    u, v, z, inside = second.project(points)
    chosen = inside & (np.abs(points[:, 2]) < 1e-3)
    rows, columns = v[chosen].astype(int), u[chosen].astype(int)
    both = np.abs(depths(town, second)[rows, columns] - z[chosen]) < 0.2
    ours = photograph(town, first).reshape(-1, 3)[chosen][both].astype(float).mean(1)
    theirs = photograph(town, second)[rows, columns][both].astype(float).mean(1)
    assert both.sum() > 20_000
    assert np.corrcoef(ours, theirs)[0, 1] > 0.9


def test_a_seed_fixes_the_bytes_and_another_one_changes_them(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        capture(tmp_path / name, 4, 96, 64, seed)
    names = sorted(p.name for p in (tmp_path / "a/photos").iterdir())
    assert len(names) == 4
    for name in names:
        same = (tmp_path / "a/photos" / name).read_bytes()
        assert same == (tmp_path / "b/photos" / name).read_bytes()
        assert same != (tmp_path / "c/photos" / name).read_bytes()
    truth = [(tmp_path / name / "truth/images.txt").read_bytes() for name in "abc"]
    assert truth[0] == truth[1] != truth[2]


def test_a_block_follows_from_the_seed_and_its_place_alone(town: Town) -> None:
    other = Town(0)
    other.block(5, 5)
    for place in ((0, 0), (-1, 0), (-3, 2)):
        assert (other.block(*place).corners == town.block(*place).corners).all()
    starts = [Town(1).block(0, 0), *(town.block(*place) for place in ((0, 0), (1, 0), (-1, 0), (0, 1)))]
    sums = [float((block.corners % BLOCK).sum()) for block in starts]
    assert len(set(sums)) == len(sums)


def test_cameras_among_the_roofs_or_with_the_horizon_in_view_are_refused(town: Town) -> None:
    down = np.diag([1.0, -1.0, -1.0])
    low = Camera(64, 48, 48, 48, 32, 24, viewmat_of(down, np.array([0.0, 0.0, 20.0])))
    with pytest.raises(ValueError, match=r"20\.0 m high"):
        depths(town, low)
    level = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    with pytest.raises(ValueError, match="horizon"):
        photograph(town, Camera(64, 48, 48, 48, 32, 24, viewmat_of(level, np.array([0.0, 0.0, 60.0]))))

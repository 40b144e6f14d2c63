"""Proves the measure of `bench mesh`: distances of the solids, and the scores of meshes whose error is known."""

from __future__ import annotations

import numpy as np
import pytest
from _mesh import truth

from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.synthetic.ray_caster import StillLife, look_at, still_life


@pytest.fixture(scope="module")
def life() -> StillLife:
    return still_life(0)


def test_points_on_a_solid_have_no_distance_and_others_theirs(life: StillLife) -> None:
    random = np.random.default_rng(0)
    for solid in life.solids:
        on = truth.on_solid(solid, 500, random)
        assert truth.distance(on, solid).max() < 1e-9
        away = on + random.normal(size=on.shape)
        distances = truth.distance(away, solid)
        dense = truth.on_solid(solid, 20_000, random)
        nearest = np.array([np.linalg.norm(dense - point, axis=1).min() for point in away[:40]])
        if not hasattr(solid, "half_height"):  # whose lower end has no samples
            assert (distances[:40] <= nearest + 1e-9).all()
        if getattr(solid, "z", 0.0) == 0.0 and not hasattr(solid, "half_height"):
            assert (nearest - distances[:40]).max() < 0.1


def table(height: float) -> Mesh:
    """A square at a height, larger than the table."""
    corners = np.array([[-3, -3, height], [3, -3, height], [3, 3, height], [-3, 3, height]], np.float32)
    return Mesh(corners[[0, 1, 2, 0, 2, 3]], np.arange(6, dtype=np.int32).reshape(2, 3))


def many(mesh: Mesh, times: int) -> Mesh:
    """Each triangle divided into four, several times over: only small ones are cut at the table's edge."""
    for _ in range(times):
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
        mesh = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    return mesh


@pytest.mark.parametrize(("height", "expected"), [(0.0, 1.0), (0.03, 1.0), (-0.045, 0.0)])
def test_a_plane_over_the_table_scores_by_its_height(
    life: StillLife, height: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(truth, "SAMPLES", 30_000)
    bare = StillLife(life.solids[:2], life.dome, life.light)  # table and floor
    points = truth.on_solid(life.solids[0], 5000, np.random.default_rng(0))
    scores = truth.scores(many(table(height), 6), points, bare)
    assert scores["precision_0.01"] == expected
    assert scores["completeness_0.01"] == pytest.approx(expected, abs=0.03)
    assert scores["chamfer"] == pytest.approx(abs(height), abs=0.01)


def test_what_no_two_cameras_see_is_not_asked_for(life: StillLife, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(truth, "SAMPLES", 3000)
    above = [look_at(np.array([0.1 * k, 0.2, 5.0]), np.zeros(3), 400, 400, 300.0) for k in range(3)]
    points = truth.visible(life, above)
    assert len(points) > 500
    assert truth.within(points).all()
    spheres = [solid for solid in life.solids if hasattr(solid, "radius") and hasattr(solid, "center")]
    for sphere in spheres:
        if not hasattr(sphere, "half_height"):
            near = np.abs(np.linalg.norm(points - sphere.center, axis=1) - sphere.radius) < 1e-6
            assert near.any()
            assert (points[near, 2] > sphere.center[2] - 0.05).all()  # their undersides are hidden from above
    assert len(truth.visible(life, above[:1])) == 0

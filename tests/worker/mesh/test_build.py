"""A mesh of a ball of Gaussians: where it lies, its colours, its box, and the refusals where there is no surface.

How true meshes of photographed scenes are is measured by `splatmill bench mesh`, not asserted here.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatmill.schema import Progress
from splatmill_worker.mesh import build as building
from splatmill_worker.mesh.build import MeshSettings, NoSurface, build, chosen
from splatmill_worker.mesh.depths import View, confirmed
from splatmill_worker.mesh.poisson import TooFine
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.synthetic.ray_caster import look_at


def ball(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Gaussians:
    """Flat opaque Gaussians on a unit ball around `shift`: red where x is larger, blue elsewhere."""
    random = np.random.default_rng(0)
    means = random.normal(size=(3000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    half = np.stack([np.ones(len(means)) + means[:, 2], -means[:, 1], means[:, 0], np.zeros(len(means))], 1)
    colors = np.where(means[:, :1] > 0, [[1.7, -1.7, -1.7]], [[-1.7, -1.7, 1.7]])
    return Gaussians(
        torch.tensor(means + shift, dtype=torch.float32),
        torch.tensor([0.05, 0.05, 0.005]).log().repeat(len(means), 1),
        torch.tensor(half, dtype=torch.float32),
        torch.full((len(means),), 4.0),
        torch.tensor(colors[:, None], dtype=torch.float32),
    )


def cameras(count: int = 12, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Camera]:
    """Cameras on a ring around the ball that rises and falls, seven units away at 70 pixels a unit."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [np.array([4 * np.cos(a), 4 * np.sin(a), 1.5 * np.cos(3 * a)]) for a in angles]
    return [look_at(eye + shift, np.array(shift), 96, 96, 140.0) for eye in eyes]


@pytest.fixture(scope="module")
def views() -> list[View]:
    renderings: list[View] = []
    build(ball(), cameras(), MeshSettings(20_000), views=renderings)
    return renderings


def test_a_ball_becomes_a_round_mesh_with_its_colours(views: list[View]) -> None:
    stages: list[Progress] = []
    built = build(ball(), cameras(), MeshSettings(20_000), told=stages.append, views=views)
    radii = np.linalg.norm(built.mesh.vertices, axis=1)
    assert np.abs(radii - 1.0).max() < 2 * built.voxel
    assert abs(np.median(radii) - 1.0) < 0.5 * built.voxel
    assert ((built.mesh.normals() * built.mesh.vertices).sum(1) > 0.5).mean() > 0.99
    colors = built.mesh.colors
    assert colors is not None
    sure = np.abs(built.mesh.vertices[:, 0]) > 0.25
    reddish = colors[:, 0].astype(int) > colors[:, 2]
    assert (reddish == (built.mesh.vertices[:, 0] > 0))[sure].mean() > 0.995
    assert built.views == 12
    assert built.extracted >= len(built.mesh.faces) > 2000
    assert stages[-1].stage == "colouring the surface"


def test_the_box_and_the_number_of_triangles_are_kept(views: list[View]) -> None:
    box = ((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0))
    upper = build(ball(), cameras(), MeshSettings(1500, box=box), views=views)
    assert 1000 < len(upper.mesh.faces) <= 1500
    assert upper.mesh.vertices[:, 2].min() > -1e-3
    assert upper.mesh.vertices[:, 2].max() > 0.8


def test_far_from_the_origin_the_mesh_is_as_good() -> None:
    shift = (1000.0, -2000.0, 500.0)
    built = build(ball(shift), cameras(shift=shift), MeshSettings(20_000))
    radii = np.linalg.norm(built.mesh.vertices.astype(np.float64) - shift, axis=1)
    assert np.abs(radii - 1.0).max() < 2.5 * built.voxel


def test_a_depth_that_no_other_view_confirms_is_left_out(views: list[View]) -> None:
    wrong = views[3].depth.clone()
    wrong[40:56, 40:56] *= 0.9
    changed = [*views[:3], replace(views[3], depth=wrong), *views[4:]]
    kept = confirmed(changed)[3].depth
    assert (views[3].depth[40:56, 40:56] > 0).all()
    assert (kept[40:56, 40:56] == 0).all()
    unchanged = confirmed(views)[3].depth
    assert (unchanged[40:56, 40:56] > 0).double().mean() > 0.9


def test_without_a_surface_it_is_refused(views: list[View]) -> None:
    faint = replace(ball(), logit_opacities=torch.full((3000,), -4.0))
    with pytest.raises(NoSurface):
        build(faint, cameras(), MeshSettings(1000))
    with pytest.raises(NoSurface):
        build(ball(), cameras(), MeshSettings(1000, box=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))), views=views)


def test_voxels_that_are_too_fine_are_refused_or_become_larger(views: list[View]) -> None:
    with pytest.raises(TooFine, match=r"0\.00\d+ is the least"):
        build(ball(), cameras(), MeshSettings(1000, voxel=1e-5), views=views)
    coarse = build(ball(), cameras(), MeshSettings(20_000, voxel=0.1), views=views)
    assert 0.05 < coarse.voxel <= 0.1
    assert coarse.extracted < 10_000


def test_of_many_cameras_an_even_choice_is_used_at_a_bounded_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building, "MOST_VIEWS", 5)
    monkeypatch.setattr(building, "MOST_PIXELS", 5 * 48 * 48)
    every = cameras(20)
    some = chosen(every)
    assert [camera.center.tolist() for camera in some] == [each.center.tolist() for each in every[::4]]
    assert {(camera.width, camera.height) for camera in some} == {(48, 48)}
    assert some[0].fx == pytest.approx(70.0)


def test_a_training_and_a_renderer_load_nothing_of_it() -> None:
    code = (
        "import sys, splatmill_worker.pipeline, splatmill_worker.render_service.app, "
        "splatmill_worker.render_service.encoding; "
        "print(sum('splatmill_worker.mesh' in name for name in sys.modules))"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "0"

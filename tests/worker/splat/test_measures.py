"""Proves what is measured: PSNR, SSIM, and the facts a plan is made from, on scenes where the truth is known.

Does not prove the thresholds that plans compare these figures with.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.scene import PointViews, Scene
from splatmill_worker.splat.evaluate import compare, psnr, ssim_map
from splatmill_worker.splat.gaussians import SH_C0
from splatmill_worker.splat.plan import facts
from splatmill_worker.splat.start import frusta
from splatmill_worker.splat.start.points import from_points
from tests.support import still_life


def image(seed: int = 0) -> torch.Tensor:
    return torch.randint(
        0, 256, (40, 56, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8
    )


def test_psnr_is_of_the_mean_squared_error() -> None:
    photo = torch.full((20, 20, 3), 100, dtype=torch.uint8)
    off = photo.float() / 255 + 0.1
    score = compare("x", off, photo)
    assert score.mse == pytest.approx(0.01, rel=1e-5)
    assert score.psnr == pytest.approx(20.0, abs=1e-3)
    assert psnr(0.0) == 100.0
    # A flat photo is the worst case: variances are differences of float32 squares, 6e-8 of 1, over C2 = 9e-4.
    assert compare("x", photo.float() / 255, photo).ssim == pytest.approx(1.0, abs=7e-5)
    assert compare("x", image().float() / 255, image()).ssim == pytest.approx(1.0, abs=1e-6)


def test_only_masked_pixels_are_judged() -> None:
    photo = image()
    mask = torch.zeros(40, 56, dtype=torch.bool)
    mask[5:20, 5:20] = True
    color = photo.float() / 255
    color[~mask] = 0.0
    assert compare("x", color, photo, mask).psnr == 100.0
    assert compare("x", color, photo, mask).ssim == pytest.approx(1.0, abs=1e-5)
    dimmed = 0.8 * color
    score = compare("x", dimmed, photo, mask)
    photo[~mask] = torch.randint(0, 256, photo[~mask].shape).to(torch.uint8)
    assert compare("x", torch.where(mask[..., None], dimmed, 1.0), photo, mask) == score


def test_ssim_is_that_of_the_training_loss() -> None:
    """Two implementations, one by banded matrices and one by convolution in float64, give the same mean."""
    photo, color = image(0), image(1).float() / 255
    by_loss = 1.0 - float(ops.loss(color.double(), photo, dssim_weight=1.0, backend="reference"))
    assert float(ssim_map(color, photo.float() / 255).mean()) == pytest.approx(by_loss, abs=1e-5)
    everywhere = torch.ones(photo.shape[:2], dtype=torch.bool)
    assert compare("x", color, photo).ssim == pytest.approx(by_loss, abs=1e-5)
    assert compare("x", color, photo, everywhere).ssim == pytest.approx(by_loss, abs=1e-5)


def tracked(gains: np.ndarray) -> tuple[Scene, list[object]]:
    """The still life with every point tracked where it projects inside a photo, exposures multiplied by `gains`."""
    world = still_life.scene()
    views = still_life.training_views()
    offsets, track = [0], []
    for point in world.points:
        for i, (camera, _, depth) in enumerate(still_life.pictures()):
            (column,), (row,), (z,), (inside,) = camera.project(point[None])
            if inside and abs(depth[int(row), int(column)] - z) < 0.05 * z:
                track.append(i)
        offsets.append(len(track))
    for view, gain in zip(views, gains, strict=True):
        view.full.rgb.copy_((view.full.rgb.float() * gain).to(torch.uint8))
    scene = replace(world, point_views=PointViews(np.array(offsets), np.array(track, dtype=np.int32)))
    from splatmill_worker.scene import Normalization

    return Normalization.of(scene).apply(scene), list(views)


def test_equal_exposures_agree_and_unequal_ones_do_not() -> None:
    count = len(still_life.scene().views)
    spreads = []
    for gains in (np.ones(count), np.where(np.arange(count) % 2, 0.6, 1.0)):
        scene, views = tracked(gains)
        spreads.append(facts.measure(scene, views, 0, None).exposure_spread)  # type: ignore[arg-type]
    assert spreads[0] is not None
    assert spreads[1] is not None
    assert spreads[0] < 0.04
    # Half of the photos differ from the other half by ln 0.6 = 0.51; the robust spread of two equal heaps is large.
    assert spreads[1] > 0.2


def test_geometry_is_measured() -> None:
    scene, views = tracked(np.ones(len(still_life.scene().views)))
    seen = facts.measure(scene, views, 2, None)  # type: ignore[arg-type]
    assert seen.view_angle is not None
    assert 20.0 < seen.view_angle < 180.0
    assert seen.distance_ratio is not None
    assert 1.0 <= seen.distance_ratio < 4.0
    assert (seen.views, seen.held_out, seen.width, seen.height) == (14, 2, 96, 72)
    without = facts.measure(still_life.scene(), still_life.training_views(), 0, None)
    assert without.exposure_spread is None
    assert without.view_angle is None


def test_a_blurred_photo_loses_nothing_by_halving() -> None:
    sharp = image()
    small = torch.nn.functional.interpolate(
        sharp.permute(2, 0, 1)[None].float(), scale_factor=0.1, mode="area"
    )
    soft = torch.nn.functional.interpolate(small, size=sharp.shape[:2], mode="bicubic").clamp(0, 255)
    blurred = soft[0].permute(1, 2, 0).to(torch.uint8)
    assert facts.halving_loss(sharp) > 40
    assert facts.halving_loss(blurred) < 2
    assert facts.halving_loss(sharp[:2, :2]) == math.inf


def test_points_become_balls_as_wide_as_their_neighbours_are_far() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), dim=-1).reshape(-1, 3)
    grid = torch.cat([grid, grid[:1]])  # a duplicate must not become a spike
    scene = from_points(grid, torch.full((65, 3), 255, dtype=torch.uint8))
    scales = scene.log_scales.exp()
    assert torch.allclose(scales[10:60], torch.ones(50, 3), atol=1e-5)
    assert float(scales.min()) > 0.3
    assert torch.allclose(torch.sigmoid(scene.logit_opacities), torch.tensor(0.1))
    assert torch.allclose(0.5 + SH_C0 * scene.sh[:, 0], torch.ones(65, 3))


def test_without_points_gaussians_start_inside_the_visual_hull() -> None:
    targets = [view.full for view in still_life.training_views(alpha=True)]
    points, colors = frusta.sample_frusta(targets, 800, 0)
    assert points.shape == (800, 3)
    assert colors.dtype == torch.uint8
    outside = 0
    for target in targets:
        columns, rows, _, inside = target.camera.project(points.double().numpy())
        assert target.alpha is not None
        alpha = target.alpha.numpy()[rows[inside].astype(int), columns[inside].astype(int)]
        outside += int((alpha == 0).sum())
    assert outside < 0.05 * 800 * len(targets)


def test_cameras_in_one_place_have_a_distance_all_the_same() -> None:
    assert frusta.median_distance(np.array([[3.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3)) == 2.0
    assert frusta.median_distance(np.zeros((3, 3)), np.zeros(3)) == 1.0

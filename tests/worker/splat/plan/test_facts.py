"""Proves what is measured about a scene before it is planned: exposures, white balance, gaps, sky, lens, pixels.

On rendered photos whose answers are known. Does not prove that thresholds on these facts are the best ones.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from splatmill_worker.scene import Lens, Normalization, PointViews, Scene
from splatmill_worker.splat.plan.facts import halving_loss, measure
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life
from tests.support.training import sparse_scene


def facts(world: Scene, views: list[TrainingView], held_out: int = 0) -> SimpleNamespace:
    """The facts as the report has them."""
    return SimpleNamespace(**measure(world, views, held_out, None)[0].as_dict())


def darkened(views: list[TrainingView], gains: tuple[float, float, float]) -> None:
    """Every second photo as if it had been taken with these gains of red, green and blue."""
    for view in views[1::2]:
        view.full.rgb.copy_((view.full.rgb.float() * torch.tensor(gains)).to(torch.uint8))


def test_photos_that_agree_are_said_to_agree() -> None:
    world, views = sparse_scene()
    result = facts(world, views)
    assert result.exposure_spread is not None
    assert result.tint_spread is not None
    assert result.exposure_spread < 0.05
    assert result.tint_spread < 0.05


def test_exposures_are_measured_in_logs() -> None:
    world, views = sparse_scene()
    darkened(views, (0.6, 0.6, 0.6))
    result = facts(world, views)
    assert result.exposure_spread is not None
    assert result.tint_spread is not None
    # Half of the photos are log(0.6) apart from the other half; the robust deviation of that is 1.4826 halves of it.
    assert 0.25 < result.exposure_spread < 0.8
    assert result.tint_spread < 0.06


def test_white_balance_is_apart_from_exposure() -> None:
    world, views = sparse_scene()
    darkened(views, (1.0, 0.8, 0.65))
    result = facts(world, views)
    assert result.tint_spread is not None
    assert result.tint_spread > 0.12


def test_errors_and_lenses_are_in_pixels_of_the_training_size() -> None:
    world, views = sparse_scene()
    size = 4 * still_life.WIDTH
    lens = Lens("SIMPLE_RADIAL", (300.0, size / 2, 3 * size / 8, 0.1), size, 3 * size // 4)
    bent = replace(
        world,
        point_errors=np.full(len(world.points), 2.0),
        views=tuple(replace(view, lens=lens) for view in world.views),
    )
    result = facts(bent, views)
    assert result.reprojection == pytest.approx(0.5)
    # k r^3 at the corner, r = 240 / 300 focal lengths from the centre; a quarter of it at the training size.
    corner = np.hypot(size / 2, 3 * size / 8) / 300.0
    assert result.lens_residual == pytest.approx(0.1 * corner**3 * 300.0 / 4, rel=1e-6)
    assert result.distorted == len(views)
    assert facts(world, views).lens_residual is None


def test_points_of_stereo_say_nothing_about_errors_and_angles() -> None:
    world, views = sparse_scene()
    own = len(world.points)
    assert world.point_views is not None
    first_view = np.zeros(own, np.int32)
    more = replace(
        world,
        points=np.concatenate([world.points, world.points]),
        colors=np.concatenate([world.colors, world.colors]),
        point_errors=np.concatenate([np.full(own, 2.0), np.full(own, 0.01)]),
        point_views=PointViews(
            np.concatenate([world.point_views.offsets, world.point_views.offsets[-1] + 1 + np.arange(own)]),
            np.concatenate([world.point_views.views, first_view]),
        ),
    )
    told = facts(replace(more, facts={"sparse_points": own}), views)
    assert told.reprojection == pytest.approx(2.0)
    assert told.view_angle == pytest.approx(facts(world, views).view_angle, rel=0.1)
    only = facts(replace(more, facts={"sparse_points": 0}), views)
    assert (only.reprojection, only.view_angle) == (None, None)
    assert only.exposure_spread is not None


def test_errors_that_are_not_known_do_not_count() -> None:
    world, views = sparse_scene()
    errors = np.full(len(world.points), np.nan)
    assert facts(replace(world, point_errors=errors), views).reprojection is None
    errors[3:6] = 1.5
    assert facts(replace(world, point_errors=errors), views).reprojection == pytest.approx(1.5)


def test_what_points_leave_open_is_measured() -> None:
    world, views = sparse_scene()
    result = facts(world, views)
    assert result.sightings is not None
    assert result.gap_share is not None
    assert result.sky_share is not None
    assert result.sightings > 50
    assert result.extent is not None
    assert 0.2 < result.extent < 3.0
    assert 0.05 < result.gap_share < 0.95
    assert result.gap_points > 100
    assert result.shell_points > 100
    assert result.shell_distance is not None
    assert result.shell_distance > 4.0
    assert 0.0 <= result.sky_share < 0.4


def test_nothing_is_said_where_nothing_can_be_known() -> None:
    world, views = sparse_scene()
    bare = replace(world, points=world.points[:3], colors=world.colors[:3], point_views=None)
    result = facts(bare, views)
    assert (result.exposure_spread, result.tint_spread, result.gap_share, result.sky_share) == (None,) * 4
    assert facts(world, still_life.training_views(alpha=True)).gap_share is None


def tracked(gains: npt.NDArray[np.float64]) -> tuple[Scene, list[TrainingView]]:
    """The still life with every point tracked in the photos that show it, exposures multiplied by `gains`."""
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
    return Normalization.of(scene).apply(scene), list(views)


def test_equal_exposures_agree_and_unequal_ones_do_not() -> None:
    count = len(still_life.scene().views)
    spreads = []
    for gains in (np.ones(count), np.where(np.arange(count) % 2, 0.6, 1.0)):
        scene, views = tracked(gains)
        spreads.append(facts(scene, views).exposure_spread)
    assert spreads[0] is not None
    assert spreads[1] is not None
    assert spreads[0] < 0.04
    # Half of the photos differ from the other half by ln 0.6 = 0.51; the robust spread of two equal heaps is large.
    assert spreads[1] > 0.2


def test_geometry_is_measured() -> None:
    scene, views = tracked(np.ones(len(still_life.scene().views)))
    result = facts(scene, views, 2)
    assert result.view_angle is not None
    assert 20.0 < result.view_angle < 180.0
    assert result.distance_ratio is not None
    assert 1.0 <= result.distance_ratio < 4.0
    assert (result.views, result.held_out, result.width, result.height) == (14, 2, 96, 72)
    directions = np.array([view.full.camera.viewmat[2, :3] for view in views])
    assert result.alignment == pytest.approx(float(np.sqrt((directions @ directions.T).mean())))
    without = facts(still_life.scene(), still_life.training_views())
    assert without.exposure_spread is None
    assert without.view_angle is None


def test_a_blurred_photo_loses_nothing_by_halving() -> None:
    random = torch.Generator().manual_seed(0)
    sharp = torch.randint(0, 256, (40, 56, 3), generator=random, dtype=torch.uint8)
    small = torch.nn.functional.interpolate(
        sharp.permute(2, 0, 1)[None].float(), scale_factor=0.1, mode="area"
    )
    soft = torch.nn.functional.interpolate(small, size=sharp.shape[:2], mode="bicubic").clamp(0, 255)
    blurred = soft[0].permute(1, 2, 0).to(torch.uint8)
    assert halving_loss(sharp) > 40
    assert halving_loss(blurred) < 2
    assert halving_loss(sharp[:2, :2]) == math.inf

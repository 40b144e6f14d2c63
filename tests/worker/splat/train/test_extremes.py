"""Proves that extreme scenes train or fail by name: what is left is finite, and what cannot be trained says so.

The cases are those that break other trainers: no light, one view, tiny pictures, everything transparent, needles,
veils, a telephoto lens, a world far from its origin. Does not prove that their results look well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.images.load import Photo
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.engine.open import gaussians_of, open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.train.loop import Trained, train
from splatmill_worker.splat.views import Target, TrainingView
from tests.support import still_life
from tests.support.training import first_engine, plan

pytestmark = pytest.mark.slow

STEPS = 120


def outcome(
    views: list[TrainingView], gaussians: Gaussians | None = None, **changes: Any
) -> Trained | TrainingFailed:
    """What training leaves, or the named failure it ends with."""
    engine = first_engine() if gaussians is None else open_engine(gaussians, "cpu")
    try:
        return train(engine, views, views[:1], plan(STEPS, **changes), extent=1.1)
    except TrainingFailed as failed:
        return failed


def sound(result: Trained | TrainingFailed) -> bool:
    """Finite Gaussians, or a failure with its name and a sentence."""
    if isinstance(result, TrainingFailed):
        return result.name in FailureName and str(result).endswith(".")
    return (
        result.gaussians.count > 0
        and bool(result.gaussians.finite().all())
        and np.isfinite(result.on_training.mse)
    )


def painted(value: int, alpha: int | None = None) -> list[TrainingView]:
    """The still life's cameras, every photo in one grey level, and with one alpha where given."""
    views = []
    for view in still_life.training_views():
        full = view.full
        cover = None if alpha is None else torch.full(full.rgb.shape[:2], alpha, dtype=torch.uint8)
        views.append(
            TrainingView(view.name, {1: full._replace(rgb=torch.full_like(full.rgb, value), alpha=cover)})
        )
    return views


@pytest.mark.parametrize(("value", "least"), [(0, 20.0), (255, 5.0)])
def test_photos_of_one_colour_are_learned(value: int, least: float) -> None:
    """White takes longer: the points leave parts of every photo bare, which show black."""
    result = outcome(painted(value))
    assert sound(result)
    assert isinstance(result, Trained)
    assert result.on_training.psnr > least


@pytest.mark.parametrize("alpha", [0, 255])
def test_alpha_of_one_value_everywhere(alpha: int) -> None:
    result = outcome(painted(120, alpha), background="random")
    assert sound(result)
    if isinstance(result, TrainingFailed):
        assert result.name is FailureName.empty_scene


def test_one_view_is_enough_to_train_on() -> None:
    result = outcome(still_life.training_views()[:1])
    assert sound(result)
    assert isinstance(result, Trained)
    assert result.on_training.psnr > 15.0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 17), (15, 16), (17, 15), (257, 1)])
def test_pictures_of_awkward_sizes(width: int, height: int) -> None:
    views = [
        TrainingView(view.name, {1: _resized(view.full, width, height)})
        for view in still_life.training_views()
    ]
    assert sound(outcome(views))


def _resized(target: Target, width: int, height: int) -> Target:
    planes = target.rgb.permute(2, 0, 1)[None].float()
    rgb = torch.nn.functional.interpolate(planes, size=(height, width), mode="area")[0]
    camera = target.camera.scaled_to(width, height)
    pixels = rgb.to(torch.uint8).permute(1, 2, 0).contiguous()
    return target._replace(camera=camera, K=torch.as_tensor(camera.K, dtype=torch.float32), rgb=pixels)


def _needles(start: Gaussians) -> None:
    start.log_scales[:, 0] += 5.0
    start.log_scales[:, 1:] -= 5.0


def _veils(start: Gaussians) -> None:
    start.log_scales[:50] = 1.0


def _pile(start: Gaussians) -> None:
    start.means[:] = start.means[0]


def _transparent(start: Gaussians) -> None:
    start.logit_opacities[:] = -5.0


def _opaque(start: Gaussians) -> None:
    start.logit_opacities[:] = 20.0


def _zero_turns(start: Gaussians) -> None:
    start.quats[::2] = 1e-20


def _at_the_camera(start: Gaussians) -> None:
    start.means[:200] = torch.from_numpy(still_life.training_views()[0].full.camera.center).float()


@pytest.mark.parametrize(
    "spoil", [_needles, _veils, _pile, _transparent, _opaque, _zero_turns, _at_the_camera]
)
def test_extreme_gaussians_to_start_with(spoil: Callable[[Gaussians], None]) -> None:
    start = gaussians_of(first_engine())
    spoil(start)
    assert sound(outcome(still_life.training_views(), start))


@pytest.mark.parametrize("zoom", [0.05, 50.0])
def test_extreme_focal_lengths(zoom: float) -> None:
    views = []
    for view in still_life.training_views():
        camera = replace(view.full.camera, fx=zoom * view.full.camera.fx, fy=zoom * view.full.camera.fy)
        views.append(
            TrainingView(
                view.name, {1: view.full._replace(camera=camera, K=torch.as_tensor(camera.K).float())}
            )
        )
    assert sound(outcome(views))


@pytest.mark.parametrize(("size", "far"), [(1e-4, 0.0), (1.0, 5e6), (1e5, 1e9)])
def test_the_size_and_place_of_the_world_do_not_matter(size: float, far: float) -> None:
    scene = still_life.scene()
    views = []
    for view in scene.views:
        views.append(replace(view, camera=view.camera.moved_to(size * view.camera.center + far)))
    moved = replace(scene, views=tuple(views), points=size * scene.points + far)
    frame = Normalization.of(moved)
    world = frame.apply(moved)
    photos = [
        TrainingView.of(Photo(view, view.camera, rgb.copy(), None, None), frame)
        for view, (_, rgb, _) in zip(moved.views, still_life.pictures(), strict=True)
    ]
    start = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))
    result, here = outcome(photos, start), outcome(still_life.training_views())
    assert isinstance(result, Trained)
    assert isinstance(here, Trained)
    assert result.on_training.psnr == pytest.approx(here.on_training.psnr, abs=0.5)

"""Proves that a pixel is an outlier where one photo alone has a large residual at a place, and not where all have one,
where too few others show the place, or where single pixels differ.

Does not prove how well movers are found in trained scenes: `splatmill bench train --scenes passed-by` measures that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Normalization
from splatmill_worker.splat.train.consensus import SIDE, Glance, compared, glance, neighbours, small
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life
from tests.support.training import first_engine, plan

Spoil = Callable[[int, torch.Tensor], None]


def glances(spoil: Spoil) -> list[Glance]:
    """All photos with their true depths, and residuals of 0.01 that `spoil` changes."""
    scale = Normalization.of(still_life.scene()).scale
    looks = []
    for number, view in enumerate(still_life.training_views()):
        depth = scale * torch.from_numpy(still_life.pictures()[number][2])
        residual = torch.full(depth.shape, 0.01)
        spoil(number, residual)
        looks.append(Glance(view.full, residual, depth, torch.ones_like(depth, dtype=torch.bool), 0.0))
    return looks


def test_what_one_photo_alone_shows_is_an_outlier_with_its_border() -> None:
    def spoil(number: int, residual: torch.Tensor) -> None:
        if number == 5:
            residual[40:50, 40:52] = 0.2

    comparisons = compared(glances(spoil))
    inside = torch.zeros(72, 96, dtype=torch.bool)
    inside[39:51, 39:53] = True
    assert float(comparisons[5].outliers[40:50, 40:52].float().mean()) > 0.9
    assert not bool((comparisons[5].outliers & ~inside).any())
    assert all(not bool(each.outliers.any()) for number, each in enumerate(comparisons) if number != 5)
    assert comparisons[5].decibels > 5.0
    assert max(each.decibels for number, each in enumerate(comparisons) if number != 5) < 1.0


def test_what_is_hard_in_every_photo_is_none() -> None:
    """A place that the model cannot show has a large residual wherever it is seen."""

    def spoil(number: int, residual: torch.Tensor) -> None:
        camera, _, depth = still_life.pictures()[number]
        rows, columns = np.mgrid[:72, :96] + 0.5
        places = camera.unproject(columns.ravel(), rows.ravel(), depth.ravel())
        near = np.linalg.norm(places, axis=1).reshape(depth.shape) < 1.0
        residual[torch.from_numpy(near)] = 0.2

    hard = sum(int((look.residual > 0.1).sum()) for look in glances(spoil))
    outliers = sum(int(each.outliers.sum()) for each in compared(glances(spoil)))
    assert hard > 5000
    assert outliers < 0.01 * hard


def test_single_pixels_are_none() -> None:
    def spoil(number: int, residual: torch.Tensor) -> None:
        if number == 5:
            residual[40, 40:52:4] = 0.5

    assert not bool(compared(glances(spoil))[5].outliers.any())


def test_what_no_two_others_show_is_none() -> None:
    def spoil(number: int, residual: torch.Tensor) -> None:
        if number == 5:
            residual[40:50, 40:52] = 0.2

    blind = [
        replace(look, depth=look.depth * (1.0 if number == 5 else 3.0))
        for number, look in enumerate(glances(spoil))
    ]
    comparison = compared(blind)[5]
    assert not bool(comparison.outliers.any())
    assert float(torch.isnan(comparison.ratio).float().mean()) > 0.95


def test_light_is_fitted_and_no_disagreement() -> None:
    engine, course = first_engine(), plan(20)
    view = still_life.training_views()[3]
    target = view.full
    shown = engine.forward(target.viewmat, target.K, 96, 72, degree=course.schedule.degree)[0]
    own = (255 * shown.clamp(0, 1)).round().to(torch.uint8)
    darker = (own.float() * 0.6 + 20).round().to(torch.uint8)
    patched = darker.clone()
    patched[30:45, 30:50] = torch.tensor([250, 10, 200], dtype=torch.uint8)
    background = torch.zeros(3)
    plain, dark, spoilt = (
        glance(engine, course, target._replace(rgb=rgb), background) for rgb in (own, darker, patched)
    )
    assert float(plain.residual.max()) < 0.01
    assert float(dark.residual.max()) < 0.01
    assert dark.light > 20.0
    assert float(spoilt.residual[32:43, 32:48].mean()) > 0.2
    assert float(spoilt.residual[:28].max()) < 0.03


@pytest.mark.parametrize(("width", "height"), [(480, 270), (97, 20), (64, 96), (10, 10)])
def test_photos_are_compared_small(width: int, height: int) -> None:
    camera = still_life.pictures()[0][0].scaled_to(width, height)
    base = still_life.training_views()[0].full
    rgb = torch.zeros(height, width, 3, dtype=torch.uint8)
    view = TrainingView("x", {1: base._replace(camera=camera, rgb=rgb)})
    target = small(view)
    assert max(target.rgb.shape) <= max(SIDE, 3)
    assert target.camera.width == target.rgb.shape[1]
    assert set(view.levels) == {1}


def test_neighbours_are_the_nearest_cameras() -> None:
    nearest = neighbours([view.full for view in still_life.training_views()])
    assert all(len(others) == 6 and number not in others for number, others in enumerate(nearest))
    assert {4, 6} <= set(nearest[5])

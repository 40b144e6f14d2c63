"""Proves what photos are said to say about a Gaussian against renderings with it and without it.

Does not prove that what is removed by it should be (test_cleaning.py), nor the compositing (tests/kernels).
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from splatmill_worker.splat.evidence import BELOW_CLAMP, HALF_LEVEL, evidence_of
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render
from splatmill_worker.splat.views import Target
from tests.support.gaussians import some_gaussians
from tests.support.still_life import training_views

GREY = torch.full((3,), 0.4)
SEEDS = 60


@pytest.fixture(scope="module")
def photos() -> list[Target]:
    """Three photos; half of the pixels of one do not count."""
    first, second, third = (view.full for view in training_views()[:3])
    mask = torch.zeros(second.rgb.shape[:2], dtype=torch.bool)
    mask[:, : mask.shape[1] // 2] = True
    return [first, second._replace(mask=mask), third]


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    """Forty Gaussians of opacities up to 0.9 about the middle of the photos; the last is behind all cameras."""
    some = some_gaussians(40, 1)
    some.means.mul_(0.15)
    some.means[-1] = 1e4
    some.logit_opacities.clamp_(max=2.0)
    return some


def squared_error(gaussians: Gaussians, photo: Target) -> float:
    """Of a rendering in float64, over the pixels that count."""
    double = gaussians.map(lambda value: value.double())
    color = render(double, photo.camera, background=GREY, backend="reference").color
    error = (color - photo.rgb.double() / 255.0).square().sum(dim=2)
    return float((error if photo.mask is None else error[photo.mask]).sum())


def without(gaussians: Gaussians, row: int) -> Gaussians:
    return gaussians.select(torch.arange(gaussians.count) != row)


@pytest.mark.slow
def test_support_is_the_error_that_a_photo_has_more_without_the_gaussian(
    gaussians: Gaussians, photos: list[Target]
) -> None:
    """Over random signs, the estimate has the true mean. Its spread is known from the seeds themselves."""
    for photo in photos:
        estimates = torch.stack([evidence_of(gaussians, [photo], GREY, seed=s).support for s in range(SEEDS)])
        mean, error = estimates.mean(dim=0), estimates.std(dim=0) / SEEDS**0.5
        whole = squared_error(gaussians, photo)
        for row in range(0, gaussians.count, 5):
            true = squared_error(without(gaussians, row), photo) - whole
            # Five standard errors, and what float32 and the cuts of the compositing move a sum of some 5,000 pixels by.
            assert abs(float(mean[row]) - true) <= 5.0 * float(error[row]) + 2e-3 + 0.01 * abs(true)


@pytest.mark.slow
def test_weights_are_what_the_colour_of_a_gaussian_changes(
    gaussians: Gaussians, photos: list[Target]
) -> None:
    """A white Gaussian among black ones over black shows its own weight."""
    evidence = evidence_of(gaussians, photos, GREY)
    total = torch.zeros(gaussians.count, dtype=torch.float64)
    peak, counts = torch.zeros_like(total), torch.zeros(gaussians.count, dtype=torch.int64)
    for photo in photos:
        for row in range(gaussians.count):
            sh = torch.full_like(gaussians.sh, -1e3)
            sh[:, 1:] = 0.0
            sh[row, 0] = 0.5 / 0.28209479177387814  # a colour of 1
            alone = replace(gaussians, sh=sh)
            shown = render(alone, photo.camera).color[..., 0].double()
            weight = (shown if photo.mask is None else shown[photo.mask]).sum()
            total[row] += weight
            peak[row] = torch.maximum(peak[row], weight)
            counts[row] += int(weight >= HALF_LEVEL)
    # float32 sums of up to 7,000 pixels in another order.
    torch.testing.assert_close(evidence.weight, total, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(evidence.peak, peak, rtol=1e-4, atol=1e-3)
    assert torch.equal(evidence.photos, counts)
    assert int(evidence.photos[-1]) == 0
    assert float(evidence.weight[-1]) == 0.0


def test_weights_add_up_over_photos_and_each_has_its_own_psnr(
    gaussians: Gaussians, photos: list[Target]
) -> None:
    apart = [evidence_of(gaussians, [photo], GREY) for photo in photos]
    together = evidence_of(gaussians, photos, GREY)
    assert together.psnrs.tolist() == pytest.approx([each.psnr for each in apart])
    assert len(set(together.psnrs.tolist())) == len(photos)
    assert together.psnr == pytest.approx(sum(each.psnr for each in apart) / len(photos))
    # The same photo twice: the random signs differ, the weights do not.
    twice = evidence_of(gaussians, [photos[0], photos[0]], GREY)
    torch.testing.assert_close(twice.weight, 2.0 * apart[0].weight)
    assert torch.equal(twice.photos, 2 * apart[0].photos)


@pytest.mark.slow
def test_an_opaque_gaussian_is_not_taken_for_one_that_shows_nothing(photos: list[Target]) -> None:
    """At the clamp of alpha no gradient flows; the passes stay below it."""
    wall = Gaussians(
        torch.zeros(1, 3),
        torch.full((1, 3), -0.5),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([20.0]),
        torch.zeros(1, 1, 3),
    )
    estimates = torch.cat([evidence_of(wall, photos[:1], GREY, seed=s).support for s in range(SEEDS)])
    nothing = wall.select(torch.zeros(0, dtype=torch.int64))
    true = squared_error(nothing, photos[0]) - squared_error(wall, photos[0])
    assert abs(true) > 1.0
    error = float(estimates.std()) / SEEDS**0.5
    # An alpha of BELOW_CLAMP in place of 1 moves the two parts of the sum, of opposite signs, by one part in a hundred.
    assert abs(float(estimates.mean()) - true) <= 5.0 * error + 1.0
    assert bool((estimates != 0.0).all())
    assert float(evidence_of(wall, photos[:1], GREY).weight[0]) > 100.0 * BELOW_CLAMP

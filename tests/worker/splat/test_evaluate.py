"""Proves PSNR and SSIM on images whose errors are known, with and without masks.

Does not prove that training improves either.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.splat.evaluate import compare, psnr


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


def test_a_fit_of_the_colours_takes_light_out_and_leaves_shape_in() -> None:
    photo = image().float() / 255
    turn = torch.tensor([[0.7, 0.1, 0.0], [0.05, 0.8, 0.1], [0.0, 0.0, 0.6]])
    lit = photo @ turn.T + torch.tensor([0.05, 0.0, 0.1])
    score = compare("x", lit, image())
    assert score.psnr < 20.0
    # Float32 images in 0 to 1: rounding leaves a mean squared error of (6e-8)^2, far below the 1e-10 that counts as 0.
    assert score.psnr_color_fitted == 100.0
    noise = 0.05 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(2))
    shaped = compare("x", 0.5 + 0.3 * (photo - 0.5) + noise, image())
    # The variance of the noise (0.05^2) in units of the photo: (0.05 / 0.3)^2, less what regression shrinks.
    assert 15.0 < shaped.psnr_color_fitted < 19.0
    assert shaped.psnr_color_fitted > shaped.psnr


def test_a_fit_of_the_colours_never_makes_worse_and_is_that_of_the_mask() -> None:
    photo = image()
    for color in (image(1).float() / 255, torch.full((40, 56, 3), 0.2), torch.zeros(40, 56, 3)):
        score = compare("x", color, photo)
        assert score.psnr_color_fitted >= score.psnr - 1e-6
    flat = compare("x", torch.full((40, 56, 3), 0.2), photo)
    constant = photo.float().div(255).flatten(0, 1)
    assert flat.psnr_color_fitted == pytest.approx(
        psnr(float((constant - constant.mean(dim=0)).square().mean())), abs=1e-4
    )
    mask = torch.zeros(40, 56, dtype=torch.bool)
    mask[5:20, 5:20] = True
    halved = torch.where(mask[..., None], 0.5 * photo.float() / 255, 1.0)
    assert compare("x", halved, photo, mask).psnr_color_fitted == 100.0


def ssim_by_definition(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """SSIM per pixel and channel [H, W, 3] as Wang et al. (2004) define it: a Gaussian window of 11 taps and sigma 1.5,
    zeros outside the image. In float64, as products with the matrices that apply the window along either axis.
    """
    a, b = (x.double().permute(2, 0, 1) for x in (image, truth))
    maps = torch.cat([a, b, a * a, b * b, a * b])
    height, width = maps.shape[1:]
    mean_a, mean_b, aa, bb, ab = (windows(height) @ maps @ windows(width)).chunk(5)
    variance_a, variance_b, covariance = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    bottom = (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return (top / bottom).permute(1, 2, 0)


def windows(size: int) -> torch.Tensor:
    """The symmetric matrix [size, size] that applies the window along one axis."""
    pixel = torch.arange(size, dtype=torch.float64)
    distance = (pixel[:, None] - pixel[None, :]).abs()
    total = sum(math.exp(-(tap**2) / (2 * 1.5**2)) for tap in range(-5, 6))
    return torch.where(distance <= 5, torch.exp(-(distance**2) / (2 * 1.5**2)) / total, 0.0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_ssim_is_that_of_the_definition(backend: Any) -> None:
    photo, color = image(0), image(1).float() / 255
    defined = float(ssim_by_definition(color, photo.float() / 255).mean())
    assert 1.0 - float(ops.loss(color, photo, dssim_weight=1.0, backend=backend)) == pytest.approx(
        defined, abs=1e-5
    )
    everywhere = torch.ones(photo.shape[:2], dtype=torch.bool)
    assert compare("x", color, photo).ssim == pytest.approx(defined, abs=1e-5)
    assert compare("x", color, photo, everywhere).ssim == pytest.approx(defined, abs=1e-5)

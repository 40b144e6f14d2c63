"""Proves PSNR and SSIM on images whose errors are known, with and without masks.

Does not prove that training improves either.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.splat.evaluate import compare, psnr, ssim_map


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

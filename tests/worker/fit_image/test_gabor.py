"""Proves that waves begin with the frequency, phase and amplitude of what is missing, and follow their Gaussians.

Not proven: how well they fit pictures (worker/bench/gabor.md).
"""

from __future__ import annotations

import math

import pytest
import torch

from splatmill_worker.fit_image import gabor
from splatmill_worker.fit_image.gabor import FittedWaves, gaussians_for, strongest
from splatmill_worker.kernels.records import Projected

AMPLITUDE = torch.tensor([0.3, -0.2, 0.1])


def spots(*centres: tuple[float, float], sigma: float = 4.0) -> Projected:
    n = len(centres)
    reach = math.sqrt(2 * math.log(255 * 0.8)) * sigma
    return Projected(
        torch.tensor(centres), torch.tensor([[sigma**-2, 0.0, sigma**-2]]).repeat(n, 1), torch.full((n,), 0.8),
        torch.zeros(n, 3), torch.ones(n), torch.full((n, 2), reach),
    )  # fmt: skip


def striped(fx: float, fy: float, phase: float, centre: tuple[float, float]) -> torch.Tensor:
    """A residual [64, 64, 3] with `phase` at `centre`."""
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    swing = torch.cos(2 * math.pi * (fx * (x - centre[0]) + fy * (y - centre[1]) + phase))
    return swing[..., None] * AMPLITUDE


@pytest.mark.parametrize(("fx", "fy"), [(0.1875, 0.0), (0.125, -0.25), (0.0, 0.3125), (0.21, 0.1)])
def test_a_wave_begins_as_that_which_is_missing(fx: float, fy: float) -> None:
    centre = (31.3, 29.8)
    _, waves = strongest(spots(centre), striped(fx, fy, 0.1, centre))
    # Frequencies are searched in steps of 1/32 cycles per pixel.
    assert torch.allclose(waves[0, :2], torch.tensor([fx, fy]), atol=1 / 64 + 1e-6)
    if max(fx * 32 % 1, fy * 32 % 1) == 0:
        # The phase may be half a turn off, with the amplitude's sign changed.
        turned = torch.cos(2 * math.pi * (waves[0, 2] - 0.1))
        assert float(turned.abs()) == pytest.approx(1.0, abs=1e-3)
        # Least squares through the alpha: the sum of alpha times the residual over that of alpha squared.
        d = torch.arange(-15, 16).float()
        alpha = 0.8 * torch.exp(-(d[:, None] ** 2 + d[None, :] ** 2) / 32)
        ratio = float(alpha.sum() / alpha.square().sum())
        assert torch.allclose(waves[0, 3:] * turned, gabor.GAIN * ratio * AMPLITUDE, rtol=0.1)


def test_waves_go_where_one_explains_most() -> None:
    residual = striped(0.1875, 0.0, 0.0, (16.0, 32.0))
    residual[:, 32:] *= 0.1
    waves = FittedWaves()
    waves.follow(torch.ones(4, dtype=torch.bool), 0)
    waves.begin(spots((50.0, 20.0), (14.0, 20.0), (50.0, 44.0), (16.0, 44.0)), residual)
    assert waves.waves.rows.tolist() == [-1, 0, -1, 1]


def test_waves_follow_the_gaussians_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gabor, "SHARE", 1.0)
    waves = FittedWaves()
    waves.follow(torch.ones(4, dtype=torch.bool), 0)
    waves.begin(spots(*[(10.0 * i + 8, 30.0) for i in range(4)]), striped(0.1875, 0.0, 0.0, (0.0, 0.0)))
    values = waves.waves.values
    assert waves.waves.rows.tolist() == [0, 1, 2, 3]
    waves.move(torch.ones(4, 6), 1.0, 1)
    moved = waves.waves.values
    assert (moved < values).all()
    waves.follow(torch.tensor([False, True, False, True]), 2)
    assert waves.waves.rows.tolist() == [0, 1, -1, -1]
    assert torch.equal(waves.waves.values, moved[[1, 3]])
    waves.move(torch.zeros(2, 6), 1.0, 2)
    assert (waves.waves.values != moved[[1, 3]]).all(), "the moments of those that stayed were lost"


def test_frequencies_stay_below_half_a_cycle_and_bad_gradients_move_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gabor, "SHARE", 1.0)
    waves = FittedWaves()
    waves.follow(torch.ones(1, dtype=torch.bool), 0)
    waves.begin(spots((32.0, 32.0)), striped(0.49, 0.0, 0.0, (0.0, 0.0)))
    for step in range(1, 40):
        waves.move(torch.full((1, 6), -1.0), 1.0, step)
    assert waves.waves.values[0, 0] == 0.5
    waves = FittedWaves()
    waves.follow(torch.ones(1, dtype=torch.bool), 0)
    waves.begin(spots((32.0, 32.0)), striped(0.25, 0.0, 0.0, (0.0, 0.0)))
    before = waves.waves.values
    waves.move(torch.full((1, 6), torch.nan), 1.0, 1)
    assert torch.equal(waves.waves.values, before)


def test_the_parameters_are_those_of_the_plain_ones() -> None:
    for limit in (4, 64, 1000):
        count = gaussians_for(limit)
        assert 9 * count + 6 * int(gabor.SHARE * count) <= 9 * limit
        assert 9 * (count + 1) + 6 * gabor.SHARE * (count + 1) > 9 * limit
    assert gaussians_for(1) == 1

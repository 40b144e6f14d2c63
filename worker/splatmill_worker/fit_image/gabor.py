"""Waves of the Gaussians of a picture: which get one, how each begins, and how it is fitted (`fit-image --gabor`).

A Gaussian with a wave is a Gabor function: its colour swings over the plane (Wurster et al. 2024, "Gabor Splatting for
High-Quality Gigapixel Image Representations"). The wave has an amplitude of its own for each channel. The opacity does
not swing, so that alpha stays between 0 and 1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import BETA1, BETA2, EPS, NYQUIST, Projected, Waves
from splatmill_worker.splat.gaussians import Gaussians

PLAIN_PARAMETERS, WAVE_PARAMETERS = 9, 6
"""Fitted parameters of a Gaussian in the plane (position 2, scales 2, rotation, opacity, colour 3), and of a wave
(frequency 2, phase, amplitude 3)."""

SHARE = 0.5
"""Share of the Gaussians that get a wave (decisions: gabor-share)."""

WINDOW = 16
"""Side of the square around a Gaussian whose residual is searched for a wave, pixels."""

SHORTEST = 0.2
"""Least cycles of a new wave over a standard deviation of its Gaussian: less is hardly more than another colour."""

GAIN = 0.5
"""Amplitude of a new wave, as a share of what fits the residual: neighbours answer to the same residual."""

CHUNK = 2048
"""Gaussians whose spectra are computed together: 100 MB."""

FREQUENCY_RATE, PHASE_RATE, AMPLITUDE_RATE = 1e-2, 3e-2, 3e-2
"""Adam's learning rates at the start of a fit: cycles per pixel, turns, colour (decisions: gabor-share)."""


def gaussians_for(limit: int) -> int:
    """How many Gaussians, SHARE of them with waves, have as many parameters as `limit` plain ones."""
    return max(1, int(limit * PLAIN_PARAMETERS / (PLAIN_PARAMETERS + SHARE * WAVE_PARAMETERS)))


class FittedWaves:
    """The waves of a fit in progress, with Adam's moments. There are none at first.

    waves: as the engine draws them, at the picture's full size.
    """

    def __init__(self) -> None:
        self.waves = Waves(torch.zeros(0, 6), torch.zeros(0, dtype=torch.int32))
        self._exp_avg = torch.zeros(0, 6)
        self._exp_avg_sq = torch.zeros(0, 6)

    def follow(self, kept: Tensor, added: int) -> None:
        """Follow the Gaussians, of which those of the mask `kept` stay and `added` are new."""
        if not len(self.waves.rows):
            self.waves = self.waves._replace(rows=torch.full((len(kept),), -1, dtype=torch.int32))
        rows = torch.cat([self.waves.rows[kept], torch.full((added,), -1, dtype=torch.int32)])
        left = rows[rows >= 0].long()
        rows[rows >= 0] = torch.arange(len(left), dtype=torch.int32)
        self.waves = Waves(self.waves.values[left], rows)
        self._exp_avg, self._exp_avg_sq = self._exp_avg[left], self._exp_avg_sq[left]

    def begin(self, projected: Projected, residual: Tensor) -> None:
        """Give waves to the Gaussians under which one explains most of `residual` [H, W, 3], until SHARE have one."""
        values, rows = self.waves
        free = torch.nonzero(rows < 0).squeeze(1)
        count = min(int(SHARE * len(rows)) - len(values), len(free))
        if count <= 0:
            return
        of_field = (field[free] for field in projected)
        energy, waves = strongest(Projected(*of_field), residual)
        best = energy.topk(count).indices.sort().values
        rows = rows.clone()
        rows[free[best]] = torch.arange(len(values), len(values) + count, dtype=torch.int32)
        self.waves = Waves(torch.cat([values, waves[best]]), rows)
        zeros = torch.zeros(count, 6)
        self._exp_avg = torch.cat([self._exp_avg, zeros])
        self._exp_avg_sq = torch.cat([self._exp_avg_sq, zeros])

    def move(self, gradient: Tensor, fall: float, step: int) -> None:
        """Take Adam's step number `step` with rates times `fall`; frequencies stay within NYQUIST."""
        gradient = torch.where(torch.isfinite(gradient), gradient, 0.0)
        self._exp_avg.lerp_(gradient, 1.0 - BETA1)
        self._exp_avg_sq.mul_(BETA2).addcmul_(gradient, gradient, value=1.0 - BETA2)
        correction = math.sqrt(1.0 - BETA2**step) / (1.0 - BETA1**step)
        rates = torch.tensor([FREQUENCY_RATE] * 2 + [PHASE_RATE] + [AMPLITUDE_RATE] * 3)
        values = self.waves.values - fall * correction * rates * self._exp_avg / (
            self._exp_avg_sq.sqrt() + EPS
        )
        values[:, :2].clamp_(-NYQUIST, NYQUIST)
        self.waves = self.waves._replace(values=values)


def strongest(projected: Projected, residual: Tensor) -> tuple[Tensor, Tensor]:
    """The wave that explains most of `residual` [H, W, 3] under each Gaussian: what it explains [N], its values [N, 6].

    The residual, weighted by the Gaussian, is searched for the peak of its spectrum, of the three channels together.
    Their common phase is that of the largest real part: half the angle of the sum of the squared coefficients.
    """
    parts = [
        _strongest(Projected(*(field[i : i + CHUNK] for field in projected)), residual)
        for i in range(0, len(projected.means2d), CHUNK)
    ]
    return torch.cat([energy for energy, _ in parts]), torch.cat([values for _, values in parts])


def _strongest(projected: Projected, residual: Tensor) -> tuple[Tensor, Tensor]:
    height, width = residual.shape[:2]
    window = torch.arange(-WINDOW // 2, WINDOW // 2)
    x, y = (projected.means2d[:, i, None].floor().long() + window for i in (0, 1))
    inside = ((x >= 0) & (x < width))[:, None, :] & ((y >= 0) & (y < height))[:, :, None]
    patches = residual[y.clamp(0, height - 1)[:, :, None], x.clamp(0, width - 1)[:, None, :]]
    dx = (x + 0.5 - projected.means2d[:, :1])[:, None, :]
    dy = (y + 0.5 - projected.means2d[:, 1:])[:, :, None]
    a, b, c = (form[:, None, None] for form in projected.conics.unbind(1))
    weight = (
        inside
        * projected.opacities[:, None, None]
        * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    )
    weighted = (patches * weight[..., None]).permute(0, 3, 1, 2)

    side = 2 * WINDOW  # padded with zeros: half as far from one frequency to the next
    fy, fx = torch.meshgrid(torch.fft.fftfreq(side), torch.fft.rfftfreq(side), indexing="ij")
    power = torch.fft.rfft2(weighted, s=(side, side)).abs().square().sum(1).flatten(1)
    widest = projected.extents.amax(1) / (2.0 * torch.log(projected.opacities * 255.0).clamp_min(0.1)).sqrt()
    distinct = torch.hypot(fx, fy).flatten() * widest[:, None] >= SHORTEST
    power = torch.where(distinct, power, 0.0)
    most, place = power.max(1)
    frequency = torch.stack([fx.flatten()[place], fy.flatten()[place]], 1)

    angle = 2.0 * math.pi * (frequency[:, 0, None, None] * dx + frequency[:, 1, None, None] * dy)
    coefficients = (weighted * torch.polar(torch.ones_like(angle), -angle)[:, None]).sum((2, 3))
    phase = 0.5 * torch.angle(coefficients.square().sum(1))
    norm = weight.square().sum((1, 2)).clamp_min(1e-6)
    amplitude = (
        2.0
        * GAIN
        * (coefficients * torch.polar(torch.ones_like(phase), -phase)[:, None]).real
        / norm[:, None]
    )
    return most / norm, torch.cat([frequency, phase[:, None] / (2.0 * math.pi), amplitude], 1)


def projected_by(
    parameters: dict[str, Tensor], viewmat: Tensor, K: Tensor, width: int, height: int
) -> Projected:
    """The Gaussians of an engine, by group, in the picture."""
    g = Gaussians(**parameters)
    return ops.project(
        g.means, g.log_scales, g.quats, g.logit_opacities, g.sh, viewmat, K, width, height, degree=0
    )

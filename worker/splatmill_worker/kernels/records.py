"""The records that callers and kernels exchange, in the same form for every backend, and the constants they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

TILE = 16
"""Side of a tile in pixels. Every tile has its own list of Gaussians; tiles are numbered row by row."""

ALPHA_MIN = 1.0 / 255.0
"""A splat with less alpha at a pixel is skipped there: it cannot change an 8-bit value."""

ALPHA_MAX = 0.999
"""Largest alpha of a splat at a pixel. It keeps 1 - alpha away from 0, so that splats behind still get a gradient."""

TRANSMITTANCE_MIN = 1e-4
"""A splat that would bring a pixel's transmittance to this or below is not blended, and ends the pixel."""

MEDIAN = 0.5
"""Transmittance at which a pixel has its median depth."""

NEAREST_HORIZON = 1e-3
"""Depth at a splat's centre over the largest depth to which its plane is followed."""

BLUR = 0.3
"""Added to both variances of a projected Gaussian, pixels^2."""

COMPENSATION_MIN = 2.5e-5
"""Smallest ratio of determinants, without and with `BLUR`, whose root scales the opacity under antialiasing."""

GROUPS = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh": 48}
"""The parameter groups of a Gaussian and the values in each; sh by coefficient, then channel."""

PARAMETERS = sum(GROUPS.values())
"""Values of a Gaussian: 59. Where groups are joined, as in moments, they follow in the order of `GROUPS`."""


BETA1, BETA2, EPS = 0.9, 0.999, 1e-15
"""Adam's factors on the first and the second moment at each step, and the least divisor (Kingma & Ba 2015; Kerbl et al.
2023). A run may choose another second factor: `Rates.beta2`."""

LEAST_BETA2 = 0.95
"""Smallest second factor: what a Gaussian makes up for after a pause is summed over 256 steps
(`reference.adam.MEMORY`), whose terms fall by beta1 / sqrt(beta2) each. With this one, less than 2e-9 of
the sum is left out."""


NYQUIST = 0.5
"""Largest frequency of a wave in x and in y, cycles per pixel."""


MOST_PAIRS = 2**31 - 1
"""(tile, Gaussian) pairs of a view at most: places in its lists are numbered in 31 bits."""


class TooManyPairs(MemoryError):
    """One view has more than MOST_PAIRS pairs; the message says about how many, and what to do."""


class Projected(NamedTuple):
    """Gaussians in the image plane of one camera, one row each. A culled one has exactly 0 in every field.

    means2d: [N, 2] pixels; the centre of pixel (0, 0) is (0.5, 0.5).
    conics: [N, 3] upper triangle a, b, c of the inverse 2-D covariance, 1/pixels^2.
    opacities: [N] after the sigmoid and, under antialiasing, the compensation.
    colors: [N, 3] spherical harmonics in the direction from the camera, clamped at 0 from below.
    depths: [N] camera z.
    extents: [N, 2] half sides in pixels of the box around the ellipse where alpha is 1/255; without gradient.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    extents: Tensor


class Waves(NamedTuple):
    """Waves of Gaussians in the image plane (Gabor functions): a second colour, times a cosine.

    At the offset (dx, dy) from its mean2d, a Gaussian with the wave (fx, fy, phase, amplitude) has the colour
    `colors + amplitude cos(2 pi (fx dx + fy dy + phase))`, which may be negative. A wave with a value that is not
    finite, or with |fx| or |fy| above NYQUIST, is not drawn and has no gradient.

    values: [M, 6] fx and fy in cycles per pixel, the phase in turns, the amplitude's red, green and blue.
    rows: int32 [N] the wave of each Gaussian as a row of values, negative for none; no two share a wave.
    """

    values: Tensor
    rows: Tensor


class Bins(NamedTuple):
    """For every tile, the Gaussians whose 1/255 ellipse reaches one of its pixel centres.

    offsets: int64 [tiles + 1]; tile t has the entries offsets[t] to offsets[t + 1] of ids.
    ids: int32 [pairs], front to back within a tile; Gaussians of equal depth by index.
    """

    offsets: Tensor
    ids: Tensor


class StepResult(NamedTuple):
    """What a training step measured before it moved the Gaussians.

    loss: (1 - w) l1 + w (1 - ssim).
    l1, ssim: means over the pixels used.
    visible: Gaussians that reach a 4x4-pixel block of the image; on a GPU, those that are not culled.
    pairs: (tile, Gaussian) pairs.
    refused: gradient values that were not finite and were left out of the update.
    """

    loss: float
    l1: float
    ssim: float
    visible: int
    pairs: int
    refused: int


class PartOf(NamedTuple):
    """The photo that a photo is a part of (decisions: photo-parts).

    width, height: in pixels.
    used: number of its pixels that are trained on.
    """

    width: int
    height: int
    used: int

    def reduced(self, factor: int) -> PartOf:
        """The same of the photo with both sides divided by `factor`."""
        return PartOf(
            *(
                max(1, round(size / over))
                for size, over in zip(self, (factor, factor, factor**2), strict=True)
            )
        )


@dataclass(frozen=True)
class Rates:
    """Adam's learning rate of each parameter group, and its factor on the second moments.

    means: world units.
    log_scales, quats, logit_opacities, sh_dc, sh_rest: units of the parameter.
    beta2: LEAST_BETA2 or more and below 1; the same in every step of a run, since the bias correction and what unseen
        Gaussians make up for follow from it and the number of the step. Another value raises ValueError.
    """

    means: float
    log_scales: float
    quats: float
    logit_opacities: float
    sh_dc: float
    sh_rest: float
    beta2: float = BETA2

    def __post_init__(self) -> None:
        if not LEAST_BETA2 <= self.beta2 < 1.0:
            raise ValueError(f"beta2: expected at least {LEAST_BETA2} and less than 1, got {self.beta2}")

    def rows(self) -> list[float]:
        """Return the rate of each of a Gaussian's 59 parameters."""
        return [
            *[self.means] * 3,
            *[self.log_scales] * 3,
            *[self.quats] * 4,
            self.logit_opacities,
            *[self.sh_dc] * 3,
            *[self.sh_rest] * 45,
        ]

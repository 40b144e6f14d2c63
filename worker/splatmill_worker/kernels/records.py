"""The records that callers and kernels exchange, in the same form for every backend, and the constants they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

TILE = 16  # side of a tile in pixels; lists are made per tile, row by row

ALPHA_MIN = 1.0 / 255.0  # below this a splat cannot change an 8-bit pixel, and is skipped
ALPHA_MAX = 0.999  # keeps 1 - alpha away from 0, so that what lies behind still gets a gradient
TRANSMITTANCE_MIN = 1e-4  # a splat that would bring the transmittance to this or below ends the pixel
BLUR = 0.3  # added to both variances of a projected splat, pixels^2
COMPENSATION_MIN = 2.5e-5  # floor of det / det' under antialiasing

Scores = Literal["plain", "absolute"]
"""Which densification scores a step adds up: "absolute" all of them, "plain" all but the sum of absolute gradients. The
GPU's adds up all of them whenever one is asked for: beside its other passes that costs next to nothing."""


class Projected(NamedTuple):
    """One row per Gaussian. A culled one has extents 0 and every other field exactly 0."""

    means2d: Tensor  # [N,2] pixels; the centre of pixel (0, 0) is (0.5, 0.5)
    conics: Tensor  # [N,3] upper triangle a, b, c of the inverse 2-D covariance, 1/pixels^2
    opacities: Tensor  # [N] after the sigmoid (and the antialiasing compensation)
    colors: Tensor  # [N,3] spherical harmonics seen from the camera, clamped at 0 below
    depths: Tensor  # [N] camera z
    extents: Tensor  # [N,2] half sides in pixels of the box around the exact 1/255 ellipse; no gradient


class Bins(NamedTuple):
    """For every tile, row-major, the Gaussians whose 1/255 ellipse reaches one of its pixel centres."""

    offsets: Tensor  # int64 [tiles + 1]
    ids: Tensor  # int32 [pairs], front to back inside a tile, ties by index


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates (betas 0.9 and 0.999, eps 1e-15), in world units for the means."""

    means: float
    log_scales: float
    quats: float
    logit_opacities: float
    sh_dc: float
    sh_rest: float

    def rows(self) -> list[float]:
        """One rate for each of the 59 rows of a block."""
        return [
            *[self.means] * 3,
            *[self.log_scales] * 3,
            *[self.quats] * 4,
            self.logit_opacities,
            *[self.sh_dc] * 3,
            *[self.sh_rest] * 45,
        ]

"""What photos show of some of the Gaussians: the part of each photo that a tile is trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.records import PartOf
from splatmill_worker.scene import Camera
from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.splat.views import Target, TrainingView

REDUCED = 4
"""Factor by which photos are reduced to find what they show."""

LEAST_LIGHT = 0.1
"""Share of a pixel's light from which the pixel shows the tile. What has less of it is trained in another tile, and
there the Gaussians of this one are a part of the context."""

LEAST_SHARE = 0.01
"""Share of a photo's pixels from which it is trained on."""

LEAST_SIDE = 32
"""Shortest side in pixels of a part that is trained on: SSIM compares windows of 11 pixels."""

GRID = 16
"""Parts begin at multiples of so many pixels, the tiles of the kernels."""


@dataclass(frozen=True)
class Part:
    """The part of a photo that shows a tile.

    left, top, right, bottom: its sides in pixels of the photo; right and bottom are outside.
    counted: bool [bottom - top, right - left], the pixels that are trained on.
    """

    left: int
    top: int
    right: int
    bottom: int
    counted: Tensor

    @property
    def pixels(self) -> int:
        """Number of pixels within the sides."""
        return self.counted.numel()

    @property
    def inside(self) -> tuple[slice, slice]:
        """Its rows and columns of the photo."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def counted_of(self, view: TrainingView) -> Tensor:
        """The pixels that are trained on and that the mask of the photo has too, bool [bottom - top, right - left]."""
        mask = view.full.mask
        return self.counted if mask is None else self.counted & mask[self.inside]

    def of(self, view: TrainingView) -> TrainingView:
        """The part as a photo of its own, with a copy of its pixels."""
        full = view.full
        camera = full.camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)
        target = Target.of(
            camera,
            full.rgb[self.inside].clone(),
            None if full.alpha is None else full.alpha[self.inside].clone(),
            self.counted_of(view),
        )
        height, width = full.rgb.shape[:2]
        used = height * width if full.mask is None else int(full.mask.sum())
        return TrainingView(view.name, {1: target._replace(part_of=PartOf(width, height, used))})


def parts(
    gaussians: Gaussians, members: Tensor, cameras: Sequence[Camera], *, antialias: bool
) -> Iterator[Part | None]:
    """The part of each camera's photo that shows the `members` bool [N] of the Gaussians; None for too little of it.

    A pixel counts where members have LEAST_LIGHT of its light, or where that is so within REDUCED pixels of it. In
    front of one another Gaussians share a pixel, so that several tiles may be trained on it.
    """
    share = torch.zeros(gaussians.count, 1, 3)
    share[:, 0] = ((members.float() - 0.5) / SH_C0)[:, None]
    engine = CpuEngine(
        Gaussians(gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.logit_opacities, share)
    )
    for camera in cameras:
        small = reduced(camera)
        light, _, _ = engine.forward(
            torch.as_tensor(small.viewmat, dtype=torch.float32),
            torch.as_tensor(small.K, dtype=torch.float32),
            small.width,
            small.height,
            degree=0,
            antialias=antialias,
        )
        yield _part(light[..., 0] >= LEAST_LIGHT, camera.width, camera.height)


def reduced(camera: Camera) -> Camera:
    """The camera for its photo reduced by REDUCED."""
    return camera.scaled_to(max(1, camera.width // REDUCED), max(1, camera.height // REDUCED))


def _part(shown: Tensor, width: int, height: int) -> Part | None:
    """The part where `shown` bool [h, w], of a photo reduced to that size, is true or next to true."""
    if float(shown.float().mean()) < LEAST_SHARE:
        return None
    wide = torch.nn.functional.max_pool2d(shown[None].float(), 3, 1, 1)
    whole = torch.nn.functional.interpolate(wide[None], size=(height, width), mode="nearest")[0, 0] > 0
    rows, columns = torch.where(whole.any(dim=1))[0], torch.where(whole.any(dim=0))[0]
    top, bottom = _aligned(int(rows[0]), int(rows[-1]) + 1, height)
    left, right = _aligned(int(columns[0]), int(columns[-1]) + 1, width)
    return Part(left, top, right, bottom, whole[top:bottom, left:right].contiguous())


def _aligned(first: int, end: int, size: int) -> tuple[int, int]:
    """The range moved out to multiples of GRID and to LEAST_SIDE, within 0 and `size`."""
    first = min(first, max(0, size - LEAST_SIDE)) // GRID * GRID
    return first, min(size, max(first + LEAST_SIDE, -(-end // GRID) * GRID))

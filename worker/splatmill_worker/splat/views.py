"""Photos as tensors in the training world, at full and at reduced resolution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill_worker.images.load import Photo
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.kernels.records import PartOf
from splatmill_worker.scene import Camera, Normalization

Float = npt.NDArray[np.float64]

CLIPPED = 254
"""Grey levels of 255 from which a value may have been clipped."""

NEGLIGIBLE = 0.02
"""Share by which a clipped value may become darker and still count."""


class Target(NamedTuple):
    """A camera and the photo that it should see.

    camera: in the training world, at the size of the photo.
    viewmat: float32 [4, 4], world to camera.
    K: float32 [3, 3], intrinsics in pixels.
    rgb: uint8 [H, W, 3].
    alpha: uint8 [H, W]; None where the photo is opaque.
    mask: bool [H, W], true at the pixels that count; None where all do.
    part_of: the photo that this one is a part of; None where it is whole.
    """

    camera: Camera
    viewmat: Tensor
    K: Tensor
    rgb: Tensor
    alpha: Tensor | None
    mask: Tensor | None
    part_of: PartOf | None = None

    @staticmethod
    def of(camera: Camera, rgb: Tensor, alpha: Tensor | None = None, mask: Tensor | None = None) -> Target:
        """The photo with the matrices of its camera."""
        viewmat, K = (torch.as_tensor(matrix, dtype=torch.float32) for matrix in (camera.viewmat, camera.K))
        return Target(camera, viewmat, K, rgb.contiguous(), alpha, mask)

    def over(self, background: Tensor) -> Tensor:
        """The photo uint8 [H, W, 3] over an RGB `background` [3] in 0 to 1."""
        return self.rgb if self.alpha is None else over(self.rgb, self.alpha, background)


def over(photo: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
    """A photo uint8 [H, W, 3] with its alpha uint8 [H, W] over an RGB `background` [3] in 0 to 1, or over black."""
    cover = alpha[..., None].float() / 255.0
    behind = 0.0 if background is None else (1.0 - cover) * (255.0 * background)
    return (photo * cover + behind + 0.5).to(torch.uint8)


@dataclass(frozen=True)
class TrainingView:
    """One photo in the training world.

    name: of the photo.
    levels: the photo by the factor that it is reduced by; 1 is the full size, the others are made on first use.
    files: where the pixels at full size lie; None: in memory. Reduced photos are not kept where it is given.
    """

    name: str
    levels: dict[int, Target]
    files: PixelFiles | None = None

    @staticmethod
    def of(photo: Photo, normalization: Normalization, files: PixelFiles | None = None) -> TrainingView:
        """The photo at full training resolution, with its camera in the training world.

        files: those that its pixels were loaded into.
        """
        mask = None if photo.mask is None or photo.mask.all() else torch.from_numpy(photo.mask)
        alpha = None if photo.alpha is None or (photo.alpha == 255).all() else torch.from_numpy(photo.alpha)
        target = Target.of(normalization.camera(photo.camera), torch.from_numpy(photo.rgb), alpha, mask)
        return TrainingView(photo.view.name, {1: target}, files)

    @property
    def full(self) -> Target:
        """The photo at full training resolution."""
        return self.levels[1]

    def relit(self, exposure: Float) -> TrainingView:
        """The view as it would be with an exposure of 1: values over exp(`exposure`) [3], of red, green and blue.

        Pixels that the photo clips, and whose values are known from below alone, count no longer where they would
        become darker.
        """
        factors = torch.exp(-torch.from_numpy(np.asarray(exposure, dtype=np.float32)))
        target = self.full
        rgb = (target.rgb.float() * factors + 0.5).clamp(0.0, 255.0).to(torch.uint8)
        known = ((target.rgb < CLIPPED) | (factors >= 1.0 - NEGLIGIBLE)).all(dim=2)
        mask = known if target.mask is None else known & target.mask
        kept = None if bool(mask.all()) else self._placed(mask)
        return replace(self, levels={1: target._replace(rgb=self._placed(rgb), mask=kept)})

    def reduced(self, factor: int) -> Target:
        """The photo with both sides divided by `factor`, averaged over area, but no side under one pixel."""
        if factor in self.levels:
            return self.levels[factor]
        target = _reduced(self.full, factor)
        if self.files is None:
            self.levels[factor] = target
        return target

    def read_ahead(self) -> None:
        """Have the photo read into memory in the background, where it lies in a file."""
        if self.files is not None:
            for plane in (self.full.rgb, self.full.alpha, self.full.mask):
                if plane is not None:
                    self.files.read_ahead(plane)

    def forget_reduced(self) -> None:
        """Free the reduced photos; `reduced` makes them again where they are asked for."""
        full = self.full
        self.levels.clear()
        self.levels[1] = full

    def placed(self, files: PixelFiles) -> TrainingView:
        """The view with its pixels in `files`."""
        view = replace(self, files=files)
        rgb, alpha, mask = (
            None if plane is None else view._placed(plane)
            for plane in (self.full.rgb, self.full.alpha, self.full.mask)
        )
        assert rgb is not None
        return replace(view, levels={1: self.full._replace(rgb=rgb, alpha=alpha, mask=mask)})

    def _placed(self, plane: Tensor) -> Tensor:
        """The plane of a photo where its pixels lie."""
        return plane if self.files is None else torch.from_numpy(self.files.placed(plane.numpy()))


def _reduced(full: Target, factor: int) -> Target:
    height, width = full.rgb.shape[:2]
    size = (max(1, round(height / factor)), max(1, round(width / factor)))

    def area(planes: Tensor) -> Tensor:  # [C, H, W] float
        return torch.nn.functional.interpolate(planes[None], size=size, mode="area")[0]

    rgb = full.rgb.permute(2, 0, 1).float()
    alpha = mask = None
    if full.alpha is None:
        rgb = area(rgb)
    else:
        # Colours are weighted by alpha, so that those of transparent pixels do not bleed in.
        cover = full.alpha[None].float() / 255.0
        small = area(cover)
        rgb = area(rgb * cover) / small.clamp_min(1.0 / 255.0)
        alpha = (small[0] * 255.0 + 0.5).to(torch.uint8)
    if full.mask is not None:
        mask = area(full.mask[None].float())[0] >= 0.5
    pixels = (rgb.clamp(0.0, 255.0) + 0.5).to(torch.uint8).permute(1, 2, 0)
    reduced = Target.of(full.camera.scaled_to(size[1], size[0]), pixels, alpha, mask)
    return reduced if full.part_of is None else reduced._replace(part_of=full.part_of.reduced(factor))

"""What photos say about every Gaussian: how much it weighs in them, and which of them it brings nearer to the truth.

The colour of a pixel is linear in the alpha of each Gaussian. A Gaussian of opacity o therefore contributes
D = o dC/do to the colour C of a pixel, and without it the squared error |C - photo|^2 becomes |C - photo - D|^2. A few
backward passes of the compositing give the sums over the pixels of a photo, for all Gaussians at once:

- the weights, sum of alpha T, as the gradient of the sum of all colours with respect to the Gaussian's colour;
- 2 (C - photo) . D, as o times the gradient of the squared error with respect to o;
- |D|^2, as the square of o times the gradient of the sum of C times random signs: products of different pixels
  cancel in the mean over signs (Hutchinson 1990), of which DRAWS are taken.

The support of a Gaussian in a photo is the sum of |D|^2 - 2 (C - photo) . D: what the squared error would grow by
without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import binned

if TYPE_CHECKING:
    from splatmill_worker.splat.views import Target

DRAWS = 3
"""Random signs of a photo. They leave |D|^2 of a Gaussian in one photo with a relative error of sqrt(2 / DRAWS)."""

HALF_LEVEL = 0.5 / 255.0
"""Half a grey level of 255. A Gaussian of less weight, in pixels, changes no 8-bit value by more than its rounding."""

BELOW_CLAMP = 0.99
"""Largest opacity in the passes: at ALPHA_MAX, the compositing clamps alpha and lets no gradient through."""


@dataclass(frozen=True)
class Evidence:
    """What M photos say about N Gaussians: `psnrs` is [M], one for each photo; every other field is [N]. Sums are over
    pixels and channels.

    weight: sum of alpha T over all photos, pixels.
    peak: the same in the photo where it is largest, pixels.
    photos: number of photos in which the weight is HALF_LEVEL or more, int64.
    support: growth of the squared error of all photos without the Gaussian, colours in 0 to 1.
    extent: largest half side of the Gaussian's box in a photo that shows it, in halves of the photo's longer side.
    depth: smallest ratio of the Gaussian's depth to the mean depth of what a photo shows at the same pixels; infinite
        where no photo shows it.
    psnrs: of each photo, dB float64, of the model with opacities up to BELOW_CLAMP.
    """

    weight: Tensor
    peak: Tensor
    photos: Tensor
    support: Tensor
    extent: Tensor
    depth: Tensor
    psnrs: Tensor

    @property
    def psnr(self) -> float:
        """Mean over the photos, dB."""
        return float(self.psnrs.mean())


def evidence_of(
    gaussians: Gaussians,
    photos: Sequence[Target],
    background: Tensor,
    *,
    antialias: bool = False,
    backend: ops.Backend | None = None,
    seed: int = 0,
) -> Evidence:
    """The evidence of `photos` on every one of `gaussians`, in one pass over the photos.

    background: RGB [3] in 0 to 1 behind the scene and behind transparent photos.
    antialias: whether the model was trained with the compensation of opacities.
    backend: the kernels; chosen by the tensors' device where None.
    seed: of the random signs.
    """
    n, like = gaussians.count, gaussians.means
    zero = like.new_zeros(n, dtype=torch.float64)
    weight, peak, support = zero.clone(), zero.clone(), zero.clone()
    counts = torch.zeros(n, dtype=torch.int64, device=like.device)
    extent, depth = like.new_zeros(n), torch.full_like(zero, float("inf"))
    random = torch.Generator().manual_seed(seed)
    decibels: list[float] = []
    for target in photos:
        one = _in_one_photo(gaussians, target, background, antialias, backend, random)
        shown = one.weight >= HALF_LEVEL
        decibels.append(one.psnr)
        weight += one.weight
        peak = torch.maximum(peak, one.weight)
        counts += shown
        support += one.support
        extent = torch.where(shown, torch.maximum(extent, one.extent), extent)
        depth = torch.where(shown, torch.minimum(depth, one.depth), depth)
    psnrs = torch.tensor(decibels, dtype=torch.float64)
    return Evidence(weight, peak, counts, support, extent, depth, psnrs)


@dataclass(frozen=True)
class _InOnePhoto:
    """The fields of Evidence of one photo."""

    weight: Tensor
    support: Tensor
    extent: Tensor
    depth: Tensor
    psnr: float


def _in_one_photo(
    gaussians: Gaussians,
    target: Target,
    background: Tensor,
    antialias: bool,
    backend: ops.Backend | None,
    random: torch.Generator,
) -> _InOnePhoto:
    camera, like = target.camera, gaussians.means
    width, height = camera.width, camera.height
    background = background.to(like.device, like.dtype)
    with torch.no_grad():
        projected, bins = binned(gaussians, camera, antialias=antialias, backend=backend)
    opacities = projected.opacities.clamp(max=BELOW_CLAMP).requires_grad_()
    colors = projected.colors.detach().requires_grad_()
    rows: Projected = projected._replace(opacities=opacities, colors=colors)
    color, alpha, depths = ops.composite(rows, bins, width, height, background=background, backend=backend)
    counted = like.new_ones(height, width) if target.mask is None else target.mask.to(like)
    photo = target.over(background.cpu()).to(like.device, like.dtype) / 255.0
    residual = (color.detach() - photo) * counted[..., None]
    shown = ((color.detach().clamp(0.0, 1.0) - photo) * counted[..., None]).double()
    error = shown.square().sum()
    mean_depth = (depths / alpha.clamp_min(1e-10)).detach()
    sums = torch.stack([counted, counted * mean_depth, torch.zeros_like(counted)], dim=-1)
    (of_colors,) = torch.autograd.grad(color, colors, sums, retain_graph=True)
    (of_error,) = torch.autograd.grad(color, opacities, 2.0 * residual, retain_graph=True)
    size = torch.zeros_like(opacities, dtype=torch.float64)
    for _ in range(DRAWS):
        signs = torch.randint(0, 2, color.shape, generator=random).to(like) * 2.0 - 1.0
        (of_signs,) = torch.autograd.grad(color, opacities, signs * counted[..., None], retain_graph=True)
        size += (opacities.detach() * of_signs).double().square() / DRAWS
    with torch.no_grad():
        weight = of_colors[:, 0].double()
        change = size - (opacities * of_error).double()
        behind = of_colors[:, 1].double() / weight.clamp_min(1e-30)
        return _InOnePhoto(
            weight,
            change,
            projected.extents.amax(dim=1) / (0.5 * max(width, height)),
            projected.depths.double() / behind.clamp_min(1e-30),
            psnr(float(error / (3.0 * counted.double().sum()).clamp_min(1.0))),
        )

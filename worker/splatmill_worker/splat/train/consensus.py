"""Which pixels of a photo no other photo agrees with: residuals, compared between photos that show the same place.

What a model cannot show (fine detail, reflections) has a large residual in every photo of it. What only one photo
shows, because it moved on, has one there alone. So the residual of a pixel is compared with those that other photos
have where they show the same place, as the model's own depths say. As in RobustNeRF (Sabour et al. 2023) and
SpotLessSplats (Sabour et al. 2024), the comparison becomes a mask by spatial coherence: single pixels are none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.splat.color_fit import changed, color_change
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.views import Target, TrainingView

SIDE = 96
"""Longest side, in pixels, at which photos are compared: things that pass by are larger than a hundredth of a photo."""

NEIGHBOURS = 6
"""Photos with the nearest cameras that a photo is compared with."""

ENOUGH = 2
"""Photos that must show a place beside the one that is judged."""

SAME_DEPTH = 0.1
"""Relative difference of depth up to which two photos show the same place."""

TRIMMED = 0.25
"""Share of the pixels with the largest residuals that the fit of a photo's colours leaves out: they may be what passes
by."""

SEED = 4.0
"""Residual over that of the other photos from which a pixel belongs to what passes by (decisions: disagreement)."""

GROWN = 2.0
"""The same for pixels beside such ones (decisions: disagreement)."""

COHERENT = 0.6
"""Share of the pixels around one that must be seeds for it to be one, as in RobustNeRF."""


@dataclass(frozen=True)
class Glance:
    """A photo and what the model shows of it, at h x w pixels.

    target: the reduced photo with its camera.
    residual: mean absolute difference of colours [h, w], after a fit of the photo's light, averaged over 3 x 3 pixels.
    depth: of what the model shows [h, w], world units; 0 where it shows nothing.
    counted: pixels that the photo's own mask keeps, bool [h, w].
    light: mean difference before the fit over that after it, over the pixels that the fit uses, dB.
    """

    target: Target
    residual: Tensor
    depth: Tensor
    counted: Tensor
    light: float


@dataclass(frozen=True)
class Comparison:
    """The residuals of a photo beside those of others.

    ratio: residual over that of the other photos at the same place, float [h, w]; NaN where too few show it.
    median: of the ratio; 0 where it is known nowhere.
    outliers: pixels that no other photo agrees with, bool [h, w].
    decibels: mean squared ratio, dB: about 0 where the photo is shown as well as the others.
    """

    ratio: Tensor
    median: float
    outliers: Tensor
    decibels: float


def small(view: TrainingView) -> Target:
    """The photo at which it is compared: not larger than SIDE, by a whole factor."""
    camera = view.full.camera
    factor = math.ceil(max(camera.width, camera.height) / SIDE)
    kept = set(view.levels)
    target = view.reduced(factor)
    if factor not in kept:
        view.levels.pop(factor, None)
    return target


def glance(engine: Engine, plan: Plan, target: Target, background: Tensor) -> Glance:
    """What the model shows of a reduced photo."""
    color, alpha, depth = (
        value.float().cpu()
        for value in engine.forward(
            target.viewmat,
            target.K,
            target.camera.width,
            target.camera.height,
            degree=plan.schedule.degree,
            background=background,
            antialias=plan.antialias,
        )
    )
    height, width = color.shape[:2]
    image = color.clamp(0.0, 1.0).reshape(-1, 3)
    photo = target.over(background).reshape(-1, 3).float() / 255.0
    counted = torch.ones(height * width, dtype=torch.bool) if target.mask is None else target.mask.reshape(-1)
    plain = fitted = (image - photo).abs().mean(dim=1)
    used = counted
    for _ in range(2):
        used = _smallest(fitted, counted)
        fitted = (changed(image, color_change(image[used], photo[used])) - photo).abs().mean(dim=1)
    light = 20.0 * math.log10(max(float(plain[used].mean()), 1e-6) / max(float(fitted[used].mean()), 1e-6))
    solid = alpha > 0.5
    return Glance(
        target=target,
        residual=_box(torch.where(counted, fitted, fitted.new_zeros(())).reshape(height, width)),
        depth=torch.where(solid, depth / alpha.clamp_min(1e-6), depth.new_zeros(())),
        counted=counted.reshape(height, width),
        light=light,
    )


class _All(NamedTuple):
    """All photos behind one another, T pixels in all, so that a photo is compared with several at once.

    residual: the largest of `Glance.residual` within a pixel [T], since depths place a pixel no better than that.
    depth, counted: of `Glance` [T].
    start: index of the first pixel of each photo [n].
    width, height: of each photo, pixels [n].
    viewmat, K: of each camera [n, 4, 4] and [n, 3, 3].
    """

    residual: Tensor
    depth: Tensor
    counted: Tensor
    start: Tensor
    width: Tensor
    height: Tensor
    viewmat: Tensor
    K: Tensor

    @staticmethod
    def of(glances: Sequence[Glance]) -> _All:
        sizes = torch.tensor([each.residual.numel() for each in glances])
        return _All(
            torch.cat([_largest(each.residual).reshape(-1) for each in glances]),
            torch.cat([each.depth.reshape(-1) for each in glances]),
            torch.cat([each.counted.reshape(-1) for each in glances]),
            sizes.cumsum(dim=0) - sizes,
            torch.tensor([each.residual.shape[1] for each in glances]),
            torch.tensor([each.residual.shape[0] for each in glances]),
            torch.stack([each.target.viewmat for each in glances]),
            torch.stack([each.target.K for each in glances]),
        )


def compared(glances: Sequence[Glance]) -> list[Comparison]:
    """Each photo's residuals beside those of the photos with the nearest cameras."""
    photos = _All.of(glances)
    floor = float(torch.cat([each.residual[each.counted] for each in glances]).median())
    nearest = neighbours([each.target for each in glances])
    return [_compared(each, photos, others, floor) for each, others in zip(glances, nearest, strict=True)]


def neighbours(targets: Sequence[Target]) -> list[list[int]]:
    """Indices of the NEIGHBOURS photos with the nearest cameras, by position and direction, for each photo."""
    centers = torch.tensor([target.camera.center.tolist() for target in targets], dtype=torch.float64)
    axes = torch.tensor([target.camera.axis.tolist() for target in targets], dtype=torch.float64)
    spread = float((centers - centers.mean(dim=0)).norm(dim=1).max())
    apart = torch.cdist(centers, centers) / max(spread, 1e-12) + torch.cdist(axes, axes)
    apart.fill_diagonal_(math.inf)
    count = min(NEIGHBOURS, len(targets) - 1)
    return [row.argsort(stable=True)[:count].tolist() for row in apart]


def _compared(photo: Glance, photos: _All, others: Sequence[int], floor: float) -> Comparison:
    expected = _expected(photo, photos, others).reshape_as(photo.residual)
    known = torch.isfinite(expected) & photo.counted
    scale = torch.where(known, expected, expected.new_zeros(())).clamp_min(floor)
    ratio = photo.residual / scale
    weak = known & (ratio > GROWN)
    seeds = (_box((known & (ratio > SEED)).float()) >= COHERENT) & weak
    worse = float((photo.residual[known] / scale[known]).square().mean()) if bool(known.any()) else 1.0
    return Comparison(
        median=float(ratio[known].median()) if bool(known.any()) else 0.0,
        ratio=torch.where(known, ratio, ratio.new_tensor(math.nan)),
        outliers=_grown(seeds, weak),
        decibels=10.0 * math.log10(max(worse, 1e-6)),
    )


def _expected(photo: Glance, photos: _All, others: Sequence[int]) -> Tensor:
    """Median residual [h w] of the photos `others` at the places that a photo shows; NaN where too few show them."""
    index = torch.tensor(others)
    viewmat, K = photos.viewmat[index], photos.K[index]
    width, height = photos.width[index, None], photos.height[index, None]
    local = _places(photo) @ viewmat[:, :3, :3].transpose(1, 2) + viewmat[:, None, :3, 3]
    z = local[..., 2]
    safe = z.clamp_min(1e-6)
    column = (local[..., 0] / safe * K[:, 0, 0, None] + K[:, 0, 2, None]).floor()
    row = (local[..., 1] / safe * K[:, 1, 1, None] + K[:, 1, 2, None]).floor()
    inside = (z > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = torch.where(inside, row * width + column, torch.zeros_like(row)).long()
    at = photos.start[index, None] + pixel
    same = (photos.depth[at] - z).abs() <= SAME_DEPTH * z
    valid = inside & same & photos.counted[at]
    residual = torch.where(valid, photos.residual[at], z.new_tensor(math.nan))
    enough = (valid.sum(dim=0) >= ENOUGH) & (photo.depth.reshape(-1) > 0)
    return torch.where(enough, residual.nanmedian(dim=0).values, z.new_tensor(math.nan))


def _places(photo: Glance) -> Tensor:
    """World positions [h w, 3] of what each pixel shows."""
    height, width = photo.depth.shape
    K, viewmat = photo.target.K, photo.target.viewmat
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    local = (torch.stack([x, y, torch.ones_like(x)], dim=2) * photo.depth[..., None]).reshape(-1, 3)
    return (local - viewmat[:3, 3]) @ viewmat[:3, :3]


def _smallest(residual: Tensor, counted: Tensor) -> Tensor:
    """The counted pixels without the TRIMMED share with the largest residuals, bool [n]."""
    if not bool(counted.any()):
        return torch.ones_like(counted)
    return counted & (residual <= torch.quantile(residual[counted], 1.0 - TRIMMED))


def _grown(seeds: Tensor, weak: Tensor) -> Tensor:
    """The weak pixels that are connected to a seed, and the pixels beside these."""
    grown = seeds
    while True:
        wider = (_around(grown) & weak) | seeds
        if torch.equal(wider, grown):
            return _around(grown)
        grown = wider


def _around(pixels: Tensor) -> Tensor:
    return _largest(pixels.float()) > 0


def _largest(values: Tensor) -> Tensor:
    """Largest value of 3 x 3 pixels [h, w]."""
    return torch.nn.functional.max_pool2d(values[None], 3, stride=1, padding=1)[0]


def _box(values: Tensor) -> Tensor:
    """Mean over 3 x 3 pixels [h, w], over those inside at the border."""
    return torch.nn.functional.avg_pool2d(
        values[None, None], 3, stride=1, padding=1, count_include_pad=False
    )[0, 0]

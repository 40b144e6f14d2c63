"""Scenes of the kernel benchmarks: fox's SfM points, the same densified, synthetic clouds. All deterministic."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from _data import FOLDERS, SHARED
from torch import Tensor

from splatmill_worker.kernels import ops

DATA = SHARED / FOLDERS["fox"]
SH_C0 = 0.28209479177387814


@dataclass
class View:
    viewmat: Tensor  # [4,4] float32
    K: Tensor
    width: int
    height: int
    photo: Tensor  # uint8 [H,W,3]


@dataclass
class Scene:
    name: str
    groups: list[Tensor]  # means, log_scales, quats, logit_opacities, sh, float32
    views: list[View]

    @property
    def count(self) -> int:
        return len(self.groups[0])


def start_from(points: Tensor, colors: Tensor) -> list[Tensor]:
    """Gaussians as training starts them: round, as wide as the mean distance to three neighbours, opacity 0.1."""
    n = len(points)
    log_scales = torch.log(ops.knn(points, backend="cpu").clamp_min(1e-7))[:, None].repeat(1, 3)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1.0
    sh = torch.zeros(n, 16, 3)
    # The middle of an 8-bit step: black would stand on the kink of the colour's clamp at 0.
    sh[:, 0] = ((colors.float() + 0.5) / 256 - 0.5) / SH_C0
    return [points, log_scales, quats, torch.full((n,), math.log(0.1 / 0.9)), sh]


def morton(points: Tensor) -> Tensor:
    """Indices that sort points [N, 3] along a Morton curve, so that neighbours in space are near in memory."""
    low, high = torch.quantile(points[:100_000], torch.tensor([0.02, 0.98]), dim=0)
    q = ((points - low) / (high - low) * 1023).clamp(0, 1023).long()
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((q[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.argsort(code, stable=True)


def densified(groups: list[Tensor], n: int) -> list[Tensor]:
    """`n` Gaussians drawn from the shapes of the given ones, as a model of a densified scene.

    They are narrowed so that the volume they fill stays as it was (scale / copies^(1/3)), get an opacity of 0.4 to 0.6
    and a slight dependence on the view.
    """
    g = torch.Generator().manual_seed(0)
    means, log_scales, _, _, sh = groups
    source = torch.arange(n) % len(means)
    copies = n / len(means)
    narrow = log_scales[source] - math.log(copies) / 3 + 0.2 * torch.randn(n, 3, generator=g)
    moved = means[source] + torch.exp(log_scales[source]) * torch.randn(n, 3, generator=g) * 0.7
    turned = torch.randn(n, 4, generator=g)
    shaded = sh[source].clone()
    shaded[:, 1:] = 0.03 * torch.randn(n, 15, 3, generator=g)
    out = [moved, narrow, turned, 0.8 * torch.rand(n, generator=g) - 0.4, shaded]
    order = morton(moved)
    return [x[order].contiguous() for x in out]


def fox(longest_side: int, n: int | None = None) -> Scene | None:
    """The fox's SfM points (n None: as they are) and its training views; None where the shared data is absent."""
    if not DATA.is_dir():
        return None
    from splatmill_worker.images.load import load_views
    from splatmill_worker.scene import split
    from splatmill_worker.sfm import posed

    poses = posed.find(DATA)
    if poses is None:
        return None
    world = poses.load()
    train, _ = split(world)
    views = []
    for photo in load_views(train, longest_side):
        camera = photo.camera
        views.append(
            View(
                torch.from_numpy(np.ascontiguousarray(camera.viewmat)).float(),
                torch.from_numpy(np.ascontiguousarray(camera.K)).float(),
                camera.width,
                camera.height,
                torch.from_numpy(np.ascontiguousarray(photo.rgb)),
            )
        )
    points, colors = torch.from_numpy(world.points).float(), torch.from_numpy(world.colors)
    order = morton(points)
    groups = start_from(points[order].contiguous(), colors[order])
    if n is None:
        return Scene("fox, SfM points", groups, views)
    return Scene(f"fox, densified to {n // 1000}k", densified(groups, n), views)


def cloud(n: int, width: int, height: int) -> Scene:
    """n Gaussians of about 1.5 pixels times (1e5 / n)^(1/3), in a ball that fills the view."""
    g = torch.Generator().manual_seed(n)
    means = torch.randn(n, 3, generator=g) * torch.tensor([1.6, 0.9, 0.9])
    size = 0.012 * (1e5 / n) ** (1 / 3)
    groups = [
        means,
        math.log(size) + 0.5 * torch.randn(n, 3, generator=g),
        torch.randn(n, 4, generator=g),
        torch.randn(n, generator=g),
        0.15 * torch.randn(n, 16, 3, generator=g),
    ]
    order = morton(means)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    focal = 0.9 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    photo = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=g)
    return Scene(
        f"cloud {n:,}", [x[order].contiguous() for x in groups], [View(viewmat, K, width, height, photo)]
    )

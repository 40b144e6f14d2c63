"""Depth hints: rendered depths are pulled to those of the reconstruction's points while the scene takes shape."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatmill_worker.scene import Scene
from splatmill_worker.splat.cells import points_of, projected
from splatmill_worker.splat.views import Target, TrainingView

WEIGHT, LAST_WEIGHT = 0.1, 0.001
"""Of the mean relative error of depth beside the photo's loss, at the beginning and at the end of the run."""

SOLID = 0.3
"""Alpha from which a pixel's depth is that of a surface."""


class DepthHints:
    """The points that each training photo shows, float32 [k, 3] as column and row (in shares of its size) and depth."""

    def __init__(self, points: Sequence[Tensor]) -> None:
        self._points = points

    @staticmethod
    def of(scene: Scene, views: Sequence[TrainingView]) -> DepthHints:
        """From the tracks of `scene`, in the world of the views."""
        hints = []
        for view, points in zip(views, points_of(scene, views), strict=True):
            camera = view.full.camera
            seen = torch.from_numpy(projected(camera, points)).float()
            hints.append(seen / torch.tensor([camera.width, camera.height, 1.0]))
        return DepthHints(hints)

    def gradient(
        self, number: int, target: Target, alpha: Tensor, depth: Tensor, progress: float
    ) -> tuple[Tensor, Tensor]:
        """Gradients [H, W] to alpha and to depth (the weighted sum) of the weighted mean of |depth / alpha - z| / z.

        The quotient does not change when all weights along a ray do, so that nothing fades for the sake of a hint.
        """
        d_alpha, d_depth = torch.zeros_like(alpha), torch.zeros_like(depth)
        hints = self._points[number].to(depth.device)
        column = (hints[:, 0] * target.camera.width).long()
        row = (hints[:, 1] * target.camera.height).long()
        cover, total, z = alpha[row, column], depth[row, column], hints[:, 2]
        solid = cover > SOLID
        if not bool(solid.any()):
            return d_alpha, d_depth
        row, column, cover, total, z = (value[solid] for value in (row, column, cover, total, z))
        weight = WEIGHT * (LAST_WEIGHT / WEIGHT) ** progress / len(hints)
        pull = weight * torch.sign(total / cover - z) / (z * cover)
        place = (row, column)
        d_depth.index_put_(place, pull, accumulate=True)
        d_alpha.index_put_(place, -pull * total / cover, accumulate=True)
        return d_alpha, d_depth

"""Small corrections of the training cameras, learned beside the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatmill_worker.splat.motion import cross_matrix, motion
from splatmill_worker.splat.views import Target, TrainingView

REACH = 6.0
"""Pixels of the full training size that a camera could go if it went on at its first rate."""

FALL = 0.1
"""Of the rate, from the beginning to the end of a run."""

FROM = 0.2
"""Share of the budget before anything moves: a scene that shows nothing yet says nothing about cameras."""

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
"""Of Adam; a camera is seen once in many steps, so that the second moment must not remember 1000 of them."""


class Poses:
    """One twist (rho, phi) [6] per training camera: its matrix is exp(twist) times the one it came with.

    rho is in world units, phi in radians, both in the camera's own axes. The seven degrees of freedom that move all
    cameras together (the world's position, direction and scale) are taken out after every step: the scene stays where
    the held-out cameras, which are left as they came, look at it.
    """

    def __init__(self, views: Sequence[TrainingView], depth: float) -> None:
        """depth: a typical distance to what is seen, by which a step of rho is as many pixels as one of phi."""
        self.given = torch.stack([torch.from_numpy(view.full.camera.viewmat) for view in views])
        focal = torch.tensor([view.full.camera.fx for view in views], dtype=torch.float64)
        self.depth = depth
        self._unit = torch.cat([torch.full((3,), depth), torch.ones(3)]).double() / focal.median()
        self._gauge = gauge(self.given)
        self._onto_gauge = torch.linalg.pinv(self._gauge / self._unit.repeat(len(views))[:, None])
        self.twists = torch.zeros(len(views), 6, dtype=torch.float64)
        self._average = torch.zeros_like(self.twists)
        self._square = torch.zeros_like(self.twists)
        self._visits = torch.zeros(len(views), dtype=torch.int64)
        self._seen = torch.zeros(len(views), dtype=torch.int64)

    def viewmat(self, number: int) -> Tensor:
        """The corrected matrix of camera `number`, float32 [4, 4]."""
        return self.matrix(number).float()

    def matrix(self, number: int) -> Tensor:
        """The same in float64."""
        return motion(self.twists[number]) @ self.given[number]

    def update(self, number: int, gradient: Tensor, progress: float, scale: float) -> None:
        """One Adam step of camera `number` down `gradient` [6], with the rate times `scale`, at `progress` in 0..1.

        A gradient that is not finite is not followed.
        """
        slope = gradient.double().cpu() * self._unit
        self._seen[number] += 1
        if progress < FROM or not bool(torch.isfinite(slope).all()):
            return
        self._visits[number] += 1
        visits = int(self._visits[number])
        self._average[number].lerp_(slope, 1.0 - BETA1)
        self._square[number].lerp_(slope.square(), 1.0 - BETA2)
        correction = math.sqrt(1.0 - BETA2**visits) / (1.0 - BETA1**visits)
        # However often the budget lets a photo come, its camera gets as far.
        rate = scale * REACH * progress / float(self._seen[number]) * FALL**progress
        move = correction * self._average[number] / (self._square[number].sqrt() + EPSILON)
        self.twists[number] -= rate * self._unit * move
        weighed = (self.twists / self._unit).reshape(-1)
        self.twists -= (self._gauge @ (self._onto_gauge @ weighed)).reshape_as(self.twists)

    def pixels_moved(self) -> float:
        """How far the corrections move what the cameras see: median over cameras, in pixels of the training size."""
        weighed = (self.twists / self._unit).reshape(-1, 2, 3)
        return float(torch.linalg.vector_norm(weighed, dim=2).amax(dim=1).median())

    def corrected(self, views: Sequence[TrainingView]) -> list[TrainingView]:
        """The views as their cameras are now."""
        return [moved(view, self.matrix(i)) for i, view in enumerate(views)]

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {
            "twists": self.twists.clone(),
            "average": self._average.clone(),
            "square": self._square.clone(),
            "visits": self._visits.clone(),
            "seen": self._seen.clone(),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """From a checkpoint."""
        self.twists.copy_(state["twists"])
        self._average.copy_(state["average"])
        self._square.copy_(state["square"])
        self._visits.copy_(state["visits"])
        self._seen.copy_(state["seen"])


def gauge(viewmats: Tensor) -> Tensor:
    """Twists [6 n, 7] of n cameras [n, 4, 4] that no photo can tell from none.

    The columns move the world along its axes, turn it about them, and scale it about its origin.
    """
    columns = []
    for viewmat in viewmats:
        rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
        block = viewmat.new_zeros(6, 7)
        block[:3, :3] = rotation
        block[:3, 3:6] = cross_matrix(shift) @ rotation
        block[3:, 3:6] = rotation
        block[:3, 6] = shift
        columns.append(block)
    return torch.cat(columns)


def moved(view: TrainingView, viewmat: Tensor) -> TrainingView:
    """The view with another camera matrix, float64 [4, 4]."""

    def turned(target: Target) -> Target:
        camera = replace(target.camera, viewmat=viewmat.numpy())
        return target._replace(camera=camera, viewmat=viewmat.float())

    return replace(view, levels={factor: turned(target) for factor, target in view.levels.items()})


def mean_depth(depth: Tensor, alpha: Tensor) -> float:
    """Mean depth of a rendered view (depth and alpha [H, W]); 1, the cameras' radius, where it shows nothing."""
    total = float(alpha.sum())
    return float(depth.sum()) / total if total > 0.0 else 1.0

"""Pose refinement: small corrections of the training cameras, optimised together with the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.motion import cross_matrix, motion
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.views import Target, TrainingView

REACH = 6.0
"""Pixels at the training size by which a run could move a camera if the rate did not fall. It does not depend on how
often the budget lets the photo come."""

RATE_FALL = 0.1
"""Rate at the end of a run over the rate at its start; it falls exponentially."""

STARTS_AT = 0.2
"""Share of the budget from which cameras move: before, the scene shows too little to align them with."""

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
"""Adam's decay of the first and second moment, and the term that keeps its divisor above 0. BETA2 is lower than usual
because a camera gets a gradient only when its photo comes."""


class Poses:
    """A twist (rho, phi) [6] per training camera: the refined viewmat is exp(twist^) times the given one.

    rho is in world units and phi in radians, both in the camera's axes. The seven gauge directions (motions of all
    cameras together that amount to moving, turning and scaling the world) are projected out after every step, so that
    the scene stays where the held-out cameras, which are not refined, look at it.

    viewmats: float64 [n, 4, 4], the viewmats as the views came with them.
    depth: typical distance from a camera to the scene, world units.
    twists: float64 [n, 6].
    """

    def __init__(self, views: Sequence[TrainingView], depth: float) -> None:
        """depth: typical distance from a camera to the scene, which says how many pixels a translation is worth."""
        self.viewmats = torch.stack([torch.from_numpy(view.full.camera.viewmat) for view in views])
        focal = torch.tensor([view.full.camera.fx for view in views], dtype=torch.float64)
        self.depth = depth
        # Each component of a twist that moves the image by one pixel.
        self._pixel = torch.cat([torch.full((3,), depth), torch.ones(3)]).double() / focal.median()
        self._gauge = gauge(self.viewmats)
        self._onto_gauge = torch.linalg.pinv(self._gauge / self._pixel.repeat(len(views))[:, None])
        self.twists = torch.zeros(len(views), 6, dtype=torch.float64)
        self._exp_avg = torch.zeros_like(self.twists)
        self._exp_avg_sq = torch.zeros_like(self.twists)
        self._updates = torch.zeros(len(views), dtype=torch.int64)
        self._visits = torch.zeros(len(views), dtype=torch.int64)

    def viewmat(self, index: int) -> Tensor:
        """The refined viewmat of camera `index`, float32 [4, 4]."""
        return self.viewmat_double(index).float()

    def viewmat_double(self, index: int) -> Tensor:
        """The refined viewmat of camera `index`, float64 [4, 4]."""
        return motion(self.twists[index]) @ self.viewmats[index]

    def update(self, index: int, gradient: Tensor, progress: float, scale: float) -> None:
        """Take one Adam step of camera `index` along `gradient` [6], the derivative of the loss by its twist.

        progress: share of the budget that is spent, 0 to 1. scale: factor on the rate. Nothing moves before STARTS_AT,
        or where the gradient is not finite.
        """
        slope = gradient.double().cpu() * self._pixel
        self._visits[index] += 1
        if progress < STARTS_AT or not bool(torch.isfinite(slope).all()):
            return
        self._updates[index] += 1
        updates = int(self._updates[index])
        self._exp_avg[index].lerp_(slope, 1.0 - BETA1)
        self._exp_avg_sq[index].lerp_(slope.square(), 1.0 - BETA2)
        correction = math.sqrt(1.0 - BETA2**updates) / (1.0 - BETA1**updates)
        # `progress` over the visits so far estimates one over the visits of the whole run.
        rate = scale * REACH * progress / float(self._visits[index]) * RATE_FALL**progress
        move = correction * self._exp_avg[index] / (self._exp_avg_sq[index].sqrt() + EPSILON)
        self.twists[index] -= rate * self._pixel * move
        in_pixels = (self.twists / self._pixel).reshape(-1)
        self.twists -= (self._gauge @ (self._onto_gauge @ in_pixels)).reshape_as(self.twists)

    def pixels_moved(self) -> float:
        """Median over the cameras of how far the correction moves the image, pixels at the training size."""
        in_pixels = (self.twists / self._pixel).reshape(-1, 2, 3)
        return float(torch.linalg.vector_norm(in_pixels, dim=2).amax(dim=1).median())

    def corrected(self, views: Sequence[TrainingView]) -> list[TrainingView]:
        """The views with their refined cameras."""
        return [with_viewmat(view, self.viewmat_double(i)) for i, view in enumerate(views)]

    def state(self) -> dict[str, Tensor]:
        """Copies of the twists and of Adam's state, for a snapshot; the keys are those of the checkpoint file."""
        return {
            "twists": self.twists.clone(),
            "average": self._exp_avg.clone(),
            "square": self._exp_avg_sq.clone(),
            "visits": self._updates.clone(),
            "seen": self._visits.clone(),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state()` returned."""
        self.twists.copy_(state["twists"])
        self._exp_avg.copy_(state["average"])
        self._exp_avg_sq.copy_(state["square"])
        self._updates.copy_(state["visits"])
        self._visits.copy_(state["seen"])


def gauge(viewmats: Tensor) -> Tensor:
    """The seven gauge directions, twists [6 n, 7] of n cameras [n, 4, 4] that change no image together with the world.

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


def with_viewmat(view: TrainingView, viewmat: Tensor) -> TrainingView:
    """The view with another viewmat, float64 [4, 4], at every resolution."""

    def turned(target: Target) -> Target:
        camera = replace(target.camera, viewmat=viewmat.numpy())
        return target._replace(camera=camera, viewmat=viewmat.float())

    return replace(view, levels={factor: turned(target) for factor, target in view.levels.items()})


def mean_depth(depth: Tensor, alpha: Tensor) -> float:
    """Mean depth of a rendered view (depth, alpha [H, W]), world units; 1, the cameras' radius, where it is empty."""
    total = float(alpha.sum())
    return float(depth.sum()) / total if total > 0.0 else 1.0


def scene_depth(engine: Engine, views: Sequence[TrainingView], plan: Plan) -> float:
    """Median, over about eight views, of the mean depth that they show before training."""
    depths = []
    for view in views[:: max(1, len(views) // 8)]:
        target = view.full
        _, alpha, depth = engine.forward(
            target.viewmat,
            target.K,
            target.camera.width,
            target.camera.height,
            degree=0,
            antialias=plan.antialias,
        )
        depths.append(mean_depth(depth, alpha))
    return sorted(depths)[len(depths) // 2]

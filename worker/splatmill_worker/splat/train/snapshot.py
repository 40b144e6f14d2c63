"""A training run between two steps, as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.train.curve import CurvePoint


@dataclass
class RunState:
    """What a run has reached beside its scene and its cameras. Checkpoints store it, and a resumed run begins with it.

    budget: what the run may spend; cut where the curve becomes flat.
    max_gaussians: most Gaussians that there may be; lower than the plan's after memory ran out.
    step: training steps so far.
    shortened: whether the budget was cut.
    curve: the evaluations so far.
    recoveries: roll-backs so far.
    rate_scale: factor on all learning rates; every roll-back from a divergence halves it.
    upcoming: indices of the photos still to come in this round, the next one last.
    ever_visible: whether any photo has shown a Gaussian.
    limited: whether the last densification would have added more Gaussians than it was allowed.
    """

    budget: Budget
    max_gaussians: int
    step: int = 0
    shortened: bool = False
    curve: tuple[CurvePoint, ...] = ()
    recoveries: int = 0
    rate_scale: float = 1.0
    upcoming: tuple[int, ...] = ()
    ever_visible: bool = False
    limited: bool = False


@dataclass(frozen=True)
class Snapshot:
    """A run between two steps. A roll-back restores what was optimised, a resumed run everything.

    parameters: copies of the Gaussians' tensors by name, as in `Gaussians`.
    exp_avg: Adam's first moments [N, 59].
    exp_avg_sq: Adam's second moments [N, 59].
    poses: `Poses.state()`; None where cameras are not refined.
    state: what the run had reached.
    seconds: training time, without evaluations and checkpoints.
    random: state of the random generator.
    view_names: names of the training views, to which the indices belong.
    best: the scene that showed the validation photos best; None where none was kept.
    lowest_loss: lowest smoothed loss so far. Checkpoints do not store it: a resumed run watches its loss anew.
    """

    parameters: dict[str, Tensor]
    exp_avg: Tensor
    exp_avg_sq: Tensor
    poses: dict[str, Tensor] | None
    state: RunState
    seconds: float
    random: Tensor
    view_names: tuple[str, ...]
    lowest_loss: float = math.inf
    best: Snapshot | None = None

    def stored(self) -> Snapshot:
        """The same on the CPU, with no best scene of its own."""
        return replace(
            self,
            parameters={name: value.cpu() for name, value in self.parameters.items()},
            exp_avg=self.exp_avg.cpu(),
            exp_avg_sq=self.exp_avg_sq.cpu(),
            best=None,
        )

    def most_opaque(self, limit: int) -> Snapshot:
        """The same with the `limit` most opaque Gaussians alone, in their order."""
        order = torch.argsort(self.parameters["logit_opacities"], descending=True, stable=True)
        kept = torch.sort(order[:limit]).values
        return replace(
            self,
            parameters={name: value[kept] for name, value in self.parameters.items()},
            exp_avg=self.exp_avg[kept],
            exp_avg_sq=self.exp_avg_sq[kept],
        )

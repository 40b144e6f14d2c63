"""A training run between two steps, as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.train.curve import CurvePoint


@dataclass(frozen=True)
class Snapshot:
    """The state of a run between two steps. A roll-back restores what was optimised, a resumed run everything.

    parameters: copies of the Gaussians' tensors by name, as in `Gaussians`.
    exp_avg: Adam's first moments [N, 59].
    exp_avg_sq: Adam's second moments [N, 59].
    poses: `Poses.state()`; None where cameras are not refined.
    step: training steps done.
    seconds: training time, without evaluations and checkpoints.
    budget: what the run may spend, as it was cut where the curve became flat.
    shortened: whether the budget was cut.
    curve: the evaluations so far.
    recoveries: roll-backs so far.
    rate_scale: factor on all learning rates; every roll-back from a divergence halves it.
    max_gaussians: most Gaussians that there may be; lower than the plan's after memory ran out.
    upcoming: indices of the photos still to come in this round, the next one last.
    random: state of the random generator.
    ever_visible: whether any photo has shown a Gaussian.
    view_names: names of the training views, to which the indices belong.
    lowest_loss: lowest smoothed loss so far. Checkpoints do not store it: a resumed run watches its loss anew.
    """

    parameters: dict[str, Tensor]
    exp_avg: Tensor
    exp_avg_sq: Tensor
    poses: dict[str, Tensor] | None
    step: int
    seconds: float
    budget: Budget
    shortened: bool
    curve: tuple[CurvePoint, ...]
    recoveries: int
    rate_scale: float
    max_gaussians: int
    upcoming: tuple[int, ...]
    random: Tensor
    ever_visible: bool
    view_names: tuple[str, ...]
    lowest_loss: float = math.inf

    @property
    def progress(self) -> float:
        """Share of the budget that was spent, 0 to 1."""
        return self.budget.progress(self.step, self.seconds)

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

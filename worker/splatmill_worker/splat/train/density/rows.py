"""Gaussians with the optimiser's moments, so that both are selected and appended together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians, concatenate


@dataclass
class Rows:
    """N Gaussians with Adam's moments.

    gaussians: the parameters.
    exp_avg: first moments [N, 59], in the engine's column order.
    exp_avg_sq: second moments [N, 59].
    """

    gaussians: Gaussians
    exp_avg: Tensor
    exp_avg_sq: Tensor

    @staticmethod
    def of(engine: Engine) -> Rows:
        """A copy of the scene and the moments that `engine` holds."""
        return Rows(Gaussians(**engine.parameters()), *engine.moments())

    def keep(self, rows: Tensor) -> Rows:
        """The rows picked by a boolean mask or by indices."""
        return Rows(self.gaussians.select(rows), self.exp_avg[rows], self.exp_avg_sq[rows])

    def grown(self, new: Gaussians) -> Rows:
        """The rows with `new` ones appended, whose moments are zero."""
        zeros = self.exp_avg.new_zeros(new.count, self.exp_avg.shape[1])
        return Rows(
            concatenate(self.gaussians, new),
            torch.cat([self.exp_avg, zeros]),
            torch.cat([self.exp_avg_sq, zeros]),
        )

    def into(self, engine: Engine) -> None:
        """Replace the scene and the moments of `engine`; its scores start at zero."""
        engine.replace(self.gaussians.parameters(), self.exp_avg, self.exp_avg_sq)

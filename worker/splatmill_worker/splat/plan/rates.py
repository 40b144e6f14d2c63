"""Learning rates of one step, per parameter group."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatmill_worker.kernels.records import Rates

POSITION_START = 1.6e-4
"""Per unit of scene extent (Kerbl et al. 2023, supplement)."""

SH_REST = 1.25e-4
"""Rate per step of the spherical harmonics above degree 0, as in the paper."""

PAPER_STEPS = 30_000
"""Steps of the run for which the paper's rates are made."""

MOST_BOOST = 8.0
"""Largest factor on the paper's rates (decisions: MOST_BOOST)."""

MOST_SH, SH_SHARE = 2.0, 2.0 / 3.0
"""The factor on SH_REST is SH_SHARE times the boost, at most MOST_SH (decisions: SH_REST). From 3300 to 30,000 steps,
this rate times the root of the number of steps is the same in every run."""


@dataclass(frozen=True)
class Annealing:
    """How the rates fall over a run.

    The position rate falls exponentially from `POSITION_START * extent` by `position_fall`; the others keep
    theirs until `hold` of the budget is spent, then fall by a half cosine to `rest_fall` of them: with
    Adam, what is left of the step size at the end is noise in the parameters.

    boost: all of them are this many times the paper's (opacities its root, since they saturate; the harmonics above the
    base colour more, see SH_REST). With Adam a parameter travels at most rate times steps, so a run shorter than the
    paper's needs longer steps to arrive. None: `boost_of` the steps that a time budget turns out to hold.
    """

    boost: float | None = 1.0
    position_fall: float = 0.01
    hold: float = 0.6
    rest_fall: float = 0.1


def boost_of(steps: int) -> float:
    """How many times the paper's rates a run of so many steps takes."""
    return min(MOST_BOOST, max(1.0, math.sqrt(PAPER_STEPS / steps)))


@dataclass(frozen=True)
class RateSchedule:
    """Rates as functions of the share of the budget that is spent.

    `scale` shortens every step, which is how a run goes on after a divergence.
    """

    extent: float
    annealing: Annealing = Annealing()
    scale: float = 1.0

    def at(self, progress: float) -> Rates:
        """Rates at `progress` in 0..1. Raises ValueError where the boost is left to a run."""
        fall = self.annealing
        boost = fall.boost
        if boost is None:
            raise ValueError("the boost is None, which only a run can fill in; give a number.")
        long = self.scale * boost
        position = POSITION_START * self.extent * math.exp(math.log(fall.position_fall) * progress)
        late = min(1.0, max(0.0, (progress - fall.hold) / (1.0 - fall.hold)))
        rest = long * (fall.rest_fall + (1.0 - fall.rest_fall) * 0.5 * (1.0 + math.cos(math.pi * late)))
        return Rates(
            means=long * position,
            log_scales=rest * 5e-3,
            quats=rest * 1e-3,
            logit_opacities=rest / math.sqrt(boost) * 5e-2,
            sh_dc=rest * 2.5e-3,
            sh_rest=rest * SH_REST * min(MOST_SH, SH_SHARE * boost),
        )

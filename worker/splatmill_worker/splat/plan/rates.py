"""Learning rates of each parameter group over a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatmill_worker.kernels.records import BETA2, Rates

POSITION_START = 1.6e-4
"""Rate of the positions at the first step, per unit of scene extent (Kerbl et al. 2023, supplement)."""

SH_REST = 1.25e-4
"""Rate per step of the spherical harmonics above degree 0, as in the paper."""

PAPER_STEPS = 30_000
"""Number of steps of the runs in the paper, for which its rates were chosen."""

MOST_BOOST = 8.0
"""Largest factor on the paper's rates (decisions: MOST_BOOST)."""

MOST_SH, SH_SHARE = 2.0, 2.0 / 3.0
"""Beside the boost, SH_REST has a factor of its own: SH_SHARE times the boost, at most MOST_SH (decisions: SH_REST).
From 3300 to 30,000 steps, the product of this rate and the number of steps is then the same in every run."""


SHORT = 3000
"""Steps of a run below which Adam averages squared gradients over fewer than the thousand steps of BETA2: the first
gradients are large, and a short run would divide its steps by them to its end (decisions: second-moment)."""

FEWEST_AVERAGED = 50
"""Steps over which squared gradients are averaged at least, in runs of up to 407 (decisions: second-moment)."""


@dataclass(frozen=True)
class Annealing:
    """How the learning rates fall over a run.

    The rate of the positions falls exponentially over the whole run. The others stay constant, then fall by half a
    cosine: with Adam, the last step size remains as noise in the parameters. A mean of the last parameters gains
    nothing beside it (decisions: averaged-parameters).

    boost: factor on the paper's rates. With Adam, a parameter moves by at most about its rate in each step, so a run
        shorter than the paper's needs higher rates. Opacities take the root of the factor, since they saturate;
        spherical harmonics above degree 0 take more (see MOST_SH). None: `boost_of` the number of steps that a time
        budget is measured to allow.
    position_fall: last rate of the positions over the first.
    hold: share of the budget for which the other rates stay constant (decisions: over-fit-of-lego).
    rest_fall: last value of the other rates over the first.
    beta2: Adam's factor on the second moments at each step.
    begin, end: the part of the fall that a run takes, 0 to 1, where another run takes the rest.
    """

    boost: float | None = 1.0
    position_fall: float = 0.01
    hold: float = 0.6
    rest_fall: float = 0.1
    beta2: float = BETA2
    begin: float = 0.0
    end: float = 1.0


def boost_of(steps: int) -> float:
    """The factor on the paper's rates for a run of so many steps: the root of the ratio, from 1 to MOST_BOOST."""
    return min(MOST_BOOST, max(1.0, math.sqrt(PAPER_STEPS / steps)))


def beta2_of(steps: int) -> float:
    """Adam's factor on the second moments in a run of so many steps: that of an average over 1 / (1 - BETA2) steps from
    SHORT on. Below, the number falls as the power 3/2 of the steps: 354 at 1500, 89 at 600, FEWEST_AVERAGED at least.
    """
    return min(BETA2, 1.0 - 1.0 / max(FEWEST_AVERAGED, math.pow(steps / SHORT, 1.5) / (1.0 - BETA2)))


@dataclass(frozen=True)
class RateSchedule:
    """Learning rates as a function of progress.

    extent: radius of the scene in the training world, in its units.
    annealing: how the rates fall.
    scale: factor on all rates; below 1 where a run resumes after a divergence.
    """

    extent: float
    annealing: Annealing = Annealing()
    scale: float = 1.0

    def at(self, progress: float) -> Rates:
        """Rates at `progress` of a run, 0 to 1. Raises ValueError where the boost is None: the run has to set it."""
        fall = self.annealing
        boost = fall.boost
        if boost is None:
            raise ValueError("annealing.boost is None; set it by boost_of(steps) before asking for rates.")
        progress = fall.begin + (fall.end - fall.begin) * progress
        factor = self.scale * boost
        position = POSITION_START * self.extent * math.exp(math.log(fall.position_fall) * progress)
        late = min(1.0, max(0.0, (progress - fall.hold) / (1.0 - fall.hold)))
        rest = factor * (fall.rest_fall + (1.0 - fall.rest_fall) * 0.5 * (1.0 + math.cos(math.pi * late)))
        # The constants are the rates of Kerbl et al. 2023 (decisions: group-rates).
        return Rates(
            means=factor * position,
            log_scales=rest * 5e-3,
            quats=rest * 1e-3,
            logit_opacities=rest / math.sqrt(boost) * 5e-2,
            sh_dc=rest * 2.5e-3,
            sh_rest=rest * SH_REST * min(MOST_SH, SH_SHARE * boost),
            beta2=fall.beta2,
        )

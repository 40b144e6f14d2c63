"""How much of the time of a whole job its training may take."""

from __future__ import annotations

from splatmill.schema import TrainOptions, format_duration
from splatmill_worker.splat.plan.evaluated import curve_views, finally_evaluated
from splatmill_worker.splat.plan.facts import Facts

EVALUATED_STEPS, COMPARED_STEPS = 1.4, 0.8
"""Time of evaluating a view, and of comparing a training photo with the others, in steps as the plan expects them
(decisions: within)."""

STORING, STORING_STEPS = 3.0, 60
"""Seconds that the files and the report take, and the steps that they take where that is more (decisions: within)."""


def training_seconds(facts: Facts, options: TrainOptions, step: float) -> tuple[float, str]:
    """The seconds of a training that time limits, and why, a clause.

    step: seconds of a training step.
    """
    if facts.seconds_left is None or options.within is None:
        assert options.time_budget is not None
        return options.time_budget, f"{options.time_budget:g} s"
    steps = max(1, int(facts.seconds_left / step))
    points = curve_views(facts.held_out, facts.views, steps)
    on_the_way = (len(points.shares) - 1) * (points.held_out + points.training)
    evaluated = on_the_way + facts.held_out + len(finally_evaluated(range(facts.views)))
    besides = (EVALUATED_STEPS * evaluated + COMPARED_STEPS * facts.views) * step
    left = facts.seconds_left - besides - max(STORING, STORING_STEPS * step)
    least = facts.views * step
    within = f"{format_duration(options.within)} for the whole job"
    if left < least:
        return least, (
            f"of {within}, the cameras have left {max(0.0, facts.seconds_left):.0f} s, too little to show each photo "
            f"once and to store the result, so that the job ends later than asked: {least:.1f} s"
        )
    if options.time_budget is not None and options.time_budget <= left:
        return options.time_budget, f"{options.time_budget:g} s"
    return left, (
        f"of {within}, {facts.seconds_left:.0f} s are left; without those for measuring and storing, {left:.0f} s"
    )

"""When a run ends: with its budget, at its target, or once further steps gain too little."""

from __future__ import annotations

from splatmill_worker.splat.train.curve import last_gain
from splatmill_worker.splat.train.run import TrainingRun

TAIL = 0.5
"""Share of the time spent so far in which the rates fall to their ends once doublings gain too little
(decisions: best-validated)."""


def reason_to_stop(run: TrainingRun) -> str:
    """Why the run ends after its last evaluation; empty where it continues. May cut the budget, and go back."""
    plan, gain = run.plan, last_gain(run.validated)
    if run.progress >= 1.0:
        why = "the budget is spent"
        if run.state.step == plan.schedule.ends_at:
            why = f"{len(run.views)} photos from one side are too few for more than {run.state.step} steps"
        if run.state.shortened and gain is not None and gain < 0.0 and run.best is not None:
            why = f"more steps over-fit, so training went back to the scene after {run.best.state.step} steps"
        elif run.state.shortened:
            why = f"another doubling of the steps would gain less than {plan.least_gain:g} dB"
        if gain is None or not plan.stops_when_flat:
            return why
        return f"{why}; the last doubling gained {gain:.2f} dB on the validation photos"
    reached = run.state.curve[-1].validation_psnr
    if plan.target_psnr is not None and reached is not None and reached >= plan.target_psnr:
        return f"the validation photos ({len(run.set_aside)}) reached {reached:.2f} dB"
    if plan.stops_when_flat and not run.state.shortened and gain is not None:
        if gain < 0.0:
            run.go_back()
        if gain < plan.least_gain:
            run.shorten(TAIL)
    return ""


def still_gains(run: TrainingRun) -> bool:
    """Whether the last doubling of the steps gained as much as the plan asks for."""
    gain = last_gain(run.validated)
    return gain is not None and gain >= run.plan.least_gain

"""The densification strategy that a plan names."""

from __future__ import annotations

from splatmill_worker.splat.density.classic import Classic
from splatmill_worker.splat.plan import Plan

PLAIN_THRESHOLD = 2e-4
ABSOLUTE_THRESHOLD = 8e-4


def densifier_of(plan: Plan) -> Classic | None:
    """None when the plan leaves densification out."""
    if plan.densify is None:
        return None
    decay = plan.schedule.opacity_decay
    if plan.densify == "classic":
        return Classic("plain", PLAIN_THRESHOLD, decay)
    return Classic("absolute", ABSOLUTE_THRESHOLD, decay)

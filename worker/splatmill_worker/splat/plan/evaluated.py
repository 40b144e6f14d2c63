"""When a run is evaluated while it trains, and on how many photos, so that this takes a bounded share of its time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

View = TypeVar("View")

EVALUATED_AT = (0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the budget at which held-out views are evaluated: close together where the curve is steep."""

SHORT_EVALUATED_AT = (0.04, 0.11, 0.22, 0.4, 0.6, 0.8, 1.0)
"""The same for runs that are too short for the longer list."""

SHARE = 0.05
"""Largest share of the training time that all evaluations take, wherever the run is long enough for the final one."""

VIEW_STEPS = 0.9
"""Time of evaluating one view, in training steps (decisions: VIEW_STEPS)."""

LEAST_HELD_OUT = 4
"""Held-out views at a point of the curve, at least; all of them where there are fewer."""

ALSO_EVALUATED = 4
"""Training views, evenly chosen, that are evaluated at each point beside the held-out ones, at most."""

FINALLY_EVALUATED = 16
"""Training views, evenly chosen, that are evaluated at the end: this many, and less than twice as many."""


class CurveViews(NamedTuple):
    """What is evaluated at each point of the curve but the last, which shows all held-out views.

    shares: of the budget, at which the points lie.
    held_out, training: number of views, evenly chosen from those there are.
    """

    shares: tuple[float, ...]
    held_out: int
    training: int


def curve_views(held_out: int, training: int, steps: int, validation: int = 0) -> CurveViews:
    """The points of the curve of a run of `steps` steps that has so many held-out, training and validation views.

    All validation views are evaluated at each point but the last: decisions compare them from point to point. The
    points depend on these numbers alone, so that runs of one plan have the same ones.
    """
    finally_ = held_out + len(finally_evaluated(range(training)))
    affordable = SHARE * steps / VIEW_STEPS - finally_
    least = min(held_out, LEAST_HELD_OUT) + 1 + validation
    shares = EVALUATED_AT if affordable >= least * (len(EVALUATED_AT) - 1) else SHORT_EVALUATED_AT
    each = max(least, int(affordable / (len(shares) - 1))) - validation
    also = min(ALSO_EVALUATED, training, max(1, each // 3))
    return CurveViews(shares, min(held_out, max(min(held_out, LEAST_HELD_OUT), each - also)), also)


def finally_evaluated(views: Sequence[View]) -> Sequence[View]:
    """Those of the training views that are evaluated at the end."""
    return views[:: max(1, len(views) // FINALLY_EVALUATED)]


def evenly(views: Sequence[View], count: int) -> list[View]:
    """`count` of the views, evenly chosen from the first on; all of them where there are no more."""
    return (
        [views[index * len(views) // count] for index in range(count)] if count < len(views) else list(views)
    )

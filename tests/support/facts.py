"""Facts of an ordinary capture, and the plans that follow from changes to them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import Facts, Speed
from splatmill_worker.splat.plan.plan import Kernels, Plan

FACTS = Facts(
    views=43,
    held_out=7,
    width=270,
    height=480,
    native_longest=960,
    points=11_450,
    source="colmap",
    transparent=0,
    masked=0,
    distorted=50,
    halving_loss=4.3,
    exposure_spread=0.02,
    light_tail=0.01,
    light_error=0.003,
    light_unseen=0.02,
    alignment=0.8,
    view_angle=30.0,
    distance_ratio=1.9,
    reprojection=0.9,
    memory_available=16 * 10**9,
    speed=Speed(per_pixel=2.6e-8, per_gaussian=9e-8),
)


def changed(facts: Facts = FACTS, **changes: Any) -> Facts:
    """`facts` with other values of some fields."""
    return replace(facts, **changes)


def planned(facts: Facts = FACTS, kernels: Kernels = "cpu", **options: Any) -> Plan:
    """The plan for `facts` with these options, as they come off the wire."""
    return decide(facts, TrainOptions.model_validate(options), kernels)

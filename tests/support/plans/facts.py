"""Facts of an ordinary capture, and the plans that follow from changes to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import Coverage, Facts, Geometry, Speed
from splatmill_worker.splat.plan.light import Light
from splatmill_worker.splat.plan.plan import Kernels, Plan


def light(
    light_tail: float, light_error: float = 0.003, light_unseen: float = 0.02, exposure_spread: float = 0.02
) -> Light:
    """The light of ten photos: all depart by `light_tail`, half of them are darker than the others."""
    darker = np.array([[1.0], [-1.0]] * 5) * exposure_spread / 1.4826
    return Light(darker + np.zeros(3), np.full((10, 3), light_tail), np.full(10, light_error), light_unseen)


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
    reprojection=0.9,
    light=light(0.01),
    geometry=Geometry(view_angle=30.0, distance_ratio=1.9),
    alignment=0.8,
    memory_available=16 * 10**9,
    speed=Speed(per_pixel=2.6e-8, per_gaussian=9e-8),
)


PARTS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "light": (
        light,
        {"light_tail": 0.01, "light_error": 0.003, "light_unseen": 0.02, "exposure_spread": 0.02},
    ),
    "geometry": (Geometry, {"view_angle": 30.0, "distance_ratio": 1.9}),
    "coverage": (
        Coverage,
        {
            "sightings": 80.0,
            "in_view": 0.8,
            "sky_share": 0.0,
            "gap_share": 0.0,
            "gap_points": 0,
            "shell_points": 0,
            "shell_distance": None,
            "extent": 1.0,
        },
    ),
}
"""How each part of the facts is made, and of which values where a test names others of them."""

NEEDED = ("light_tail", "distance_ratio", "sky_share", "gap_share")
"""Values without which their part is absent."""


def changed(facts: Facts = FACTS, **changes: Any) -> Facts:
    """`facts` with other values of some fields; those of a part by their names in the report."""
    for part, (make, usual) in PARTS.items():
        own = {name: changes.pop(name) for name in usual if name in changes}
        if own:
            present = getattr(facts, part)
            known = usual if present is None or part == "light" else asdict(present)
            absent = any(own.get(name, 0.0) is None for name in NEEDED)
            changes[part] = None if absent else make(**known | own)
    return replace(facts, **changes)


def planned(facts: Facts = FACTS, kernels: Kernels = "cpu", **options: Any) -> Plan:
    """The plan for `facts` with these options, as they come off the wire."""
    return decide(facts, TrainOptions.model_validate(options), kernels)

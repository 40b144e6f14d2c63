"""Every decision of a training as a factor with levels that a test can force, read from TrainOptions and Plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import StrEnum
from typing import Any, Literal, get_args, get_origin, get_type_hints

from splatmill.schema import TrainOptions
from splatmill_worker.kernels.gpu.device import absence
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import Annealing
from splatmill_worker.splat.plan.schedule import Schedule
from tests.support.plans.pairwise import Pair

STEPS = 6

LONGEST = 32
"""Pixels of the longer side of the photos."""


@dataclass(frozen=True)
class Forced:
    """What forces one level of a decision.

    options: fields of TrainOptions.
    plan: fields of the plan in place of those that were decided, with dots into its schedule.
    capture: what the capture is like: "points", "hull", "random" or "model" (what training starts from), "masked",
        "distorted".
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    plan: Mapping[str, Any] = field(default_factory=dict)
    capture: tuple[str, ...] = ()


def _by_plan(name: str, **levels: Any) -> dict[str, Forced]:
    return {level: Forced(plan={name: value}) for level, value in levels.items()}


def _by_option(name: str, *levels: Any) -> dict[str, Forced]:
    return {str(level): Forced({name: level}) for level in levels}


ALL = Budget(STEPS)

NAMED: dict[str, dict[str, Forced]] = {
    "initial": {name: Forced(capture=(name,)) for name in ("points", "hull", "random", "model")},
    "masks": {"some": Forced(capture=("masked",)), "none": Forced()},
    "undistortion": {"some": Forced(capture=("distorted",)), "none": Forced()},
    "end": {
        "steps": Forced({"steps": STEPS}),
        "time": Forced({"time_budget": 600}, {"schedule.budget": Budget(STEPS, 600.0)}),
        "target": Forced({"target_psnr": 45}, {"schedule.budget": ALL}),
        "flat": Forced(
            plan={
                "schedule.budget": ALL,
                "schedule.longest": 2 * STEPS,
                "stops_when_flat": True,
                "validation": 1,
            }
        ),
    },
    "image_size": _by_plan("image_size", full=LONGEST, halved=LONGEST // 2),
    "holdout": _by_option("holdout", 0, 8),
    "max_gaussians": _by_option("max_gaussians", 60, 2000),
    "max_memory": _by_option("max_memory", None, 300_000_000),
    "sh_degree": _by_option("sh_degree", 0, 1, 2, 3),
    "schedule.resolution": _by_plan(
        "schedule.resolution", reduced=((0, 4), (2, 2), (5, 1)), full=((0, 1),), always=((0, 2),)
    ),
    "schedule.opacity_decay": _by_plan("schedule.opacity_decay", some=0.9, none=1.0),
    "schedule.decay_within": _by_plan("schedule.decay_within", near=1.0, everywhere=None),
    "schedule.annealing": _by_plan(
        "schedule.annealing", of_time=Annealing(boost=None), of_steps=Annealing(boost=4.0, beta2=0.96)
    ),
    "schedule.dropout": _by_plan("schedule.dropout", some=0.2, none=0.0),
    "schedule.earlier_visits": _by_plan("schedule.earlier_visits", some=150.0, none=0.0),
    "schedule.ends_at": _by_plan("schedule.ends_at", early=STEPS - 2, never=None),
}
"""Decisions whose levels do not follow from their type. The dropout of a schedule begins after MANY_VISITS."""

ELSEWHERE = {
    **dict.fromkeys(
        (
            "schedule.budget",
            "steps",
            "time_budget",
            "within",
            "target_psnr",
            "stops_when_flat",
            "validation",
            "least_gain",
            "schedule.longest",
        ),
        "end",
    ),
    "schedule.degree": "sh_degree",
    "kernels": "backend",
    "start": "initial",
}
"""Fields that another factor sets, and which one."""

NO_DECISION = {
    "schedule": "its fields are factors",
    "schedule.densify_from": "early in all runs",
    "schedule.densify_every": "often in all runs",
    "schedule.densify_until": "late in all runs",
    "schedule.expected_steps": "follows from the end",
    "schedule.in_view": "of which the other fields of the schedule are made",
    "schedule.position_scale": "a factor on a rate in all runs",
    "seed": "changes no path",
    "reasons": "words",
    "left_out": "words",
    "forced": "words",
    "test_views": "another way to hold photos out",
    "max_video_frames": "the capture has no video",
    "mapper": "the cameras are given",
    "matcher": "the cameras are given",
    "sfm_effort": "the cameras are given",
    "scale": "refused where cameras are given",
    "tiles": "another way to train, whose parts have these plans",
}
"""Fields that no factor sets, and why."""

ALWAYS = {
    "schedule.densify_from": 2,
    "schedule.densify_every": 2,
    "schedule.densify_until": 0.9,
    "schedule.expected_steps": STEPS,
}
"""Fields of every plan, so that runs of STEPS steps densify."""


def factors() -> dict[str, dict[str, Forced]]:
    """Every decision, by the name of its field. Switches, flags and choices are found by their types."""
    levels = dict(NAMED)
    known = {*NAMED, *ELSEWHERE, *NO_DECISION}
    for name, option in TrainOptions.model_fields.items():
        kind = option.annotation
        if name in known:
            continue
        if kind is bool:
            levels[name] = _by_option(name, True, False)
        elif isinstance(kind, type) and issubclass(kind, StrEnum):
            levels[name] = _by_option(name, *(choice.value for choice in kind if choice.value != "auto"))
        else:
            raise AssertionError(f"The option {name} is new here: name its levels in NAMED.")
    for name, kind in _fields_of_plan().items():
        if name in levels or name in known:
            continue
        if kind is bool:
            levels[name] = _by_plan(name, on=True, off=False)
        elif get_origin(kind) is Literal:
            levels[name] = _by_plan(name, **{str(value): value for value in get_args(kind)})
        else:
            raise AssertionError(f"The field {name} of the plan is new here: name its levels in NAMED.")
    # The reference last: a row has it only where that adds a pair, since it is slow.
    levels["backend"] = {name: levels["backend"][name] for name in ("cpu", "gpu", "reference")}
    if absence() is not None:
        del levels["backend"]["gpu"]
    return levels


def refused(known: Mapping[str, Mapping[str, Forced]]) -> set[Pair]:
    """The pairs that a run refuses: without points there is nothing to seed or to compare, and not all kernels cull."""
    pairs = {
        frozenset(((name, "on"), ("initial", initial)))
        for name in ("far_shell", "gaps")
        for initial in ("hull", "random", "model")
    } | {frozenset((("exposure", "on"), ("initial", initial))) for initial in ("hull", "random")}
    for backend in {"gpu", "reference"} & set(known["backend"]):
        pairs.add(frozenset((("cluster_culling", "on"), ("backend", backend))))
    if "gpu" in known["backend"]:
        pairs.add(frozenset((("pose_refinement", "on"), ("backend", "gpu"))))
    return pairs


def revised(plan: Plan, changes: Mapping[str, Any]) -> Plan:
    """`plan` with fields replaced; a dot leads into its schedule."""
    schedule = {name.partition(".")[2]: value for name, value in changes.items() if "." in name}
    rest = {name: value for name, value in changes.items() if "." not in name}
    return replace(plan, schedule=replace(plan.schedule, **schedule), **rest)


def _fields_of_plan() -> dict[str, Any]:
    hints, schedule = get_type_hints(Plan), get_type_hints(Schedule)
    assert is_dataclass(Plan)
    return {each.name: hints[each.name] for each in fields(Plan)} | {
        f"schedule.{each.name}": schedule[each.name] for each in fields(Schedule)
    }

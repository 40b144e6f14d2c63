"""What is trained differently: one switch each, as data, so that a row says exactly what it changed."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal

from _train.scenes import Scene
from splatmill_worker import sfm
from splatmill_worker.splat.plan.plan import Plan

DEFAULT = "default"


@dataclass(frozen=True)
class Configuration:
    """One switch against what the plan decides by itself.

    what: the switch in words. options: fields of TrainOptions. plan: fields of the plan that was made, with dots
    into its parts ("schedule.opacity_decay"). gives: fields of the plan that the options lead to; where a plan has them
    anyway, the switch changes nothing. instead: functions of the program, by dotted name, and which of `_train.instead`
    takes the place of each. photos: the switch means something on such photos only. points: it asks for points of the
    scene.
    """

    what: str
    options: dict[str, Any] = field(default_factory=dict)
    gives: dict[str, Any] = field(default_factory=dict)
    plan: dict[str, Any] = field(default_factory=dict)
    instead: dict[str, str] = field(default_factory=dict)
    photos: Literal["any", "opaque", "transparent"] = "any"
    points: bool = False

    def concerns(self, scene: Scene) -> bool:
        """Whether the switch means something there."""
        photos = "transparent" if scene.transparent else "opaque"
        return (
            self.photos in ("any", photos)
            and (scene.points or not self.points)
            and not (scene.posed and self.recovers)
        )

    @property
    def recovers(self) -> bool:
        """Whether cameras are recovered otherwise, so that those of other configurations are not its own."""
        return any(name.startswith(f"{sfm.__name__}.") for name in self.instead)

    def changes(self, plan: dict[str, Any]) -> bool:
        """Whether the switch makes another plan of a row's plan, in which what is off or None is absent."""
        settings = self.gives | self.plan
        return not settings or any(
            (_at(plan, path) or None) != (value or None) for path, value in settings.items()
        )


def _option(what: str, name: str, value: str, gives: bool, *, points: bool = False) -> Configuration:
    return Configuration(what, {name: value}, {name: gives}, points=points)


CONFIGURATIONS = {
    DEFAULT: Configuration("what the plan decides"),
    "no-coarse-to-fine": Configuration(
        "photos at full size from the first step", plan={"schedule.resolution": [[0, 1]]}
    ),
    "no-densification": Configuration(
        "the Gaussians to start with stay as many", {"densify": "off"}, {"densify": None}
    ),
    "no-opacity-decay": Configuration(
        "opacities stay as they are when Gaussians are added", plan={"schedule.opacity_decay": 1.0}
    ),
    "late-growth": Configuration(
        "Gaussians are added up to 0.7 of the run where photos differ in their light too",
        plan={"schedule.densify_until": 0.7},
    ),
    "no-dropout": Configuration(
        "all Gaussians in every step, however often photos come", plan={"schedule.dropout": 0.0}
    ),
    "not-watched": Configuration(
        "all photos from the first step, to the end of the budget",
        plan={"validation": None, "stops_when_flat": False},
    ),
    "not-doubled": Configuration("the steps of a preset stay as many", plan={"schedule.longest": None}),
    "late-fall": Configuration(
        "rates fall after 60 % of the budget, however few the photos", plan={"schedule.annealing.hold": 0.6}
    ),
    "not-ended": Configuration(
        "few photos from one side are trained to the end of the budget",
        instead={"splatmill_worker.splat.plan.capacity.most_steps": "no_most_steps"},
    ),
    "long-average": Configuration(
        "squared gradients averaged over a thousand steps", plan={"schedule.annealing.beta2": 0.999}
    ),
    "sh-0": Configuration("colour does not change with the view", {"sh_degree": 0}, {"schedule.degree": 0}),
    "sh-3": Configuration("SH degree 3 whatever the views' angles", {"sh_degree": 3}, {"schedule.degree": 3}),
    "no-annealing": Configuration(
        "rates stay as they start",
        plan={"schedule.annealing.position_fall": 1.0, "schedule.annealing.rest_fall": 1.0},
    ),
    "paper-rates": Configuration(
        "steps as long as in the paper's 30,000", plan={"schedule.annealing.boost": 1.0}
    ),
    "position-annealing-only": Configuration(
        "only the position rate falls, as in the paper", plan={"schedule.annealing.rest_fall": 1.0}
    ),
    "antialias": _option("opacities compensated for the 0.3 px dilation", "antialias", "on", True),
    "no-antialias": _option("no such compensation", "antialias", "off", False),
    "even-light": _option(
        "photos are brought to the light of those around", "exposure", "on", True, points=True
    ),
    "uneven-light": _option("photos keep their exposures", "exposure", "off", False),
    "no-random-background": Configuration(
        "white behind transparent photos",
        {"background": "white"},
        {"background": "white"},
        photos="transparent",
    ),
    "black-background": Configuration(
        "black behind the Gaussians", {"background": "black"}, {"background": "black"}, photos="opaque"
    ),
    "far-shell": _option("a far shell of Gaussians behind the scene", "far_shell", "on", True, points=True),
    "no-far-shell": _option("no such shell", "far_shell", "off", False),
    "gaps": _option("Gaussians where photos show what no point describes", "gaps", "on", True, points=True),
    "no-gaps": _option("no such Gaussians", "gaps", "off", False),
    "cluster-culling": _option(
        "steps leave out clusters of Gaussians out of view", "cluster_culling", "on", True
    ),
    "no-cluster-culling": _option("every step computes all Gaussians", "cluster_culling", "off", False),
    "pose-refinement": _option("training cameras are corrected", "pose_refinement", "on", True),
    "no-pose-refinement": _option("cameras stay as they are", "pose_refinement", "off", False),
    "probe-of-the-start": Configuration(
        "the forecast is made from the Gaussians of the start",
        instead={"splatmill_worker.splat.plan.probe.grown": "not_grown"},
    ),
    "folds-left": Configuration(
        "sides that look alike may lie on each other",
        instead={"splatmill_worker.sfm.solve.unfold": "left_folded"},
    ),
    "outliers-masked": Configuration(
        "pixels that no other photo agrees with count no longer",
        instead={"splatmill_worker.splat.train.disagreement.disagreements": "without_outliers"},
    ),
    "named-photos-skipped": Configuration(
        "no step is taken on photos that disagree for a reason",
        instead={"splatmill_worker.splat.train.disagreement.disagreements": "without_named_photos"},
    ),
    "cleaned": Configuration(
        "Gaussians that the photos do not support are removed at the end",
        instead={"splatmill_worker.pipeline.training.train": "trained_and_cleaned"},
    ),
}
"""The switches by name. A name never changes its meaning, since measured rows refer to it."""

TAKEN_OUT = {
    "exposure": "an affine colour fitted for each photo",
    "no-exposure": "no such colour",
    "absolute": "densification by absolute gradients (Ye et al. 2024)",
    "sky": "a far shell of Gaussians where photos show sky, and only there",
    "no-sky": "no such shell where photos show sky",
    "mcmc": "MCMC relocation and noise (Kheradmand et al. 2024)",
    "clone-split": "small Gaussians are cloned, large ones split at random (Kerbl et al. 2023)",
    "sh-at-once": "the last SH degree from the start, as now, against one after the other (Kerbl et al. 2023)",
}
"""Names of switches that rows have but the code no longer has."""


def named(name: str) -> Configuration:
    """The configuration of a name. Raises ValueError, as a sentence, for an unknown one."""
    if name not in CONFIGURATIONS:
        raise ValueError(f"There is no configuration {name!r}; there are {', '.join(CONFIGURATIONS)}.")
    return CONFIGURATIONS[name]


def revised(plan: Plan, changes: dict[str, Any]) -> Plan:
    """`plan` with the fields at the dotted paths replaced and named in `forced`.

    Raises ValueError for a path that leads to no field.
    """
    for path, value in changes.items():
        plan = _with(plan, path.split("."), value, path)
    return replace(plan, forced=(*plan.forced, *changes))


def _with(part: Any, names: list[str], value: Any, path: str) -> Any:
    known = [each.name for each in fields(part)] if is_dataclass(part) else []
    if names[0] not in known:
        where = type(part).__name__
        raise ValueError(f"{path} leads to no field: {where} has {', '.join(known) or 'none'}.")
    if len(names) > 1:
        value = _with(getattr(part, names[0]), names[1:], value, path)
    elif isinstance(value, list):
        value = tuple(tuple(each) if isinstance(each, list) else each for each in value)
    return replace(part, **{names[0]: value})


def _at(plan: dict[str, Any], path: str) -> Any:
    part: Any = plan
    for name in path.split("."):
        part = part.get(name) if isinstance(part, dict) else None
    return part

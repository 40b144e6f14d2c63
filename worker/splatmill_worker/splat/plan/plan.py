"""What a run does and what it leaves out, each with the sentence of the fact that decided it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.rates import Annealing
from splatmill_worker.splat.plan.schedule import Schedule

Kernels = Literal["reference", "cpu", "gpu"]

BYTES_PER_GAUSSIAN = 59 * 4 * 8
"""Parameters and two moments, twice while they are rewritten, the snapshot, and room for the kernels' records."""


@dataclass(frozen=True)
class Plan:
    """The whole course of a run. What is not needed is None or absent.

    image_size: longest side in pixels. background: what is behind Gaussians and transparent photos while training.
    far_shell: Gaussians stand behind all. gaps: Gaussians are put where photos show what no point describes.
    pose_refinement: training cameras are corrected. `reasons` has one sentence per field;
    `left_out` one per thing that this scene does not need; `forced` names the fields that an option fixed.
    """

    schedule: Schedule
    image_size: int
    max_gaussians: int
    densify: bool
    initial: Literal["points", "random", "model"]
    kernels: Kernels
    background: Literal["black", "white", "random"]
    exposure: bool
    antialias: bool
    target_psnr: float | None
    max_memory: int | None
    stops_when_flat: bool
    seed: int
    far_shell: bool = False
    gaps: bool = False
    pose_refinement: bool = False
    reasons: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    forced: tuple[str, ...] = ()

    def as_dict(self, *, whole: bool = False) -> dict[str, Any]:
        """Plain values for the report and the plan event, what is not done being absent; `whole` to read back."""
        values = asdict(self)
        if whole:
            return values
        return {name: value for name, value in values.items() if value is not None and value is not False}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Plan:
        """What `as_dict(whole=True)` gave, after a trip through JSON."""
        course = dict(values["schedule"])
        course["budget"] = Budget(**course["budget"])
        course["annealing"] = Annealing(**course["annealing"])
        course["resolution"] = tuple((first, factor) for first, factor in course["resolution"])
        fields = {**values, "schedule": Schedule(**course), "forced": tuple(values["forced"])}
        return Plan(**fields)

    @staticmethod
    def gaussians_within(memory: int) -> int:
        """How many Gaussians may be held in `memory` bytes beside the photos and the program itself."""
        return max(1000, (memory - 350 * 10**6) // BYTES_PER_GAUSSIAN)

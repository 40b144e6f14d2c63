"""The plan of a run: what it does, what it leaves out, and a sentence of explanation for each."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.rates import Annealing
from splatmill_worker.splat.plan.schedule import Schedule

Kernels = Literal["reference", "cpu", "gpu"]

BYTES_PER_GAUSSIAN = 59 * 4 * 16
"""Memory of one Gaussian in training: 59 parameters of 4 bytes, times sixteen. That is parameters and two moments in
the engine, in the last good snapshot, and twice while Gaussians are added, and a third of that for the kernels' records
(decisions: BYTES_PER_GAUSSIAN)."""

BYTES_OF_BEST = 59 * 4 * 3
"""The same in the best snapshot, of a training that validation photos may end."""

BYTES_OF_PROGRAM = 350 * 10**6
"""Memory that is assumed for the program and the photos."""


@dataclass(frozen=True)
class Plan:
    """All decisions of a run. What the scene does not need is None or False.

    schedule: resolution, degree, densification and rates over the run.
    image_size: longest side of the photos, pixels.
    max_gaussians: largest number of Gaussians.
    densify: Gaussians are added in training.
    initial: what the first Gaussians are made from: points, the visual hull, random places, or a given model.
    kernels: the backend of the engine.
    background: colour behind Gaussians and transparent photos in training.
    exposure: training photos are brought to the light that the photos around them have.
    antialias: opacities are compensated for the 0.3 pixels by which projection widens every Gaussian.
    target_psnr: PSNR of the validation photos at which training ends, dB; None: none.
    max_memory: limit of the memory in use, bytes; None: none.
    stops_when_flat: training ends early, from its best scene, once the last doubling of the steps has gained less than
        `least_gain` on the validation photos.
    seed: of all random numbers.
    far_shell: Gaussians stand behind the scene, wherever photos look.
    gaps: Gaussians are added where photos show something that no point describes.
    pose_refinement: the cameras of training photos are corrected.
    cluster_culling: steps leave out clusters of Gaussians that the photo does not show.
    validation: number of training photos that are set aside for `target_psnr` and `stops_when_flat`; None: neither.
    least_gain: dB, for `stops_when_flat`; 0 where training ends only once it over-fits.
    lpips: LPIPS of the held-out photos is measured at the end.
    reasons: a sentence for each field of the plan.
    left_out: a sentence for each thing that this scene does not need.
    forced: names of what an option fixed.
    """

    schedule: Schedule
    image_size: int
    max_gaussians: int
    densify: bool
    initial: Literal["points", "hull", "random", "model"]
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
    cluster_culling: bool = False
    validation: int | None = None
    least_gain: float = 0.02
    lpips: bool = False
    reasons: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    forced: tuple[str, ...] = ()

    def as_dict(self, *, whole: bool = False) -> dict[str, Any]:
        """The plan as plain values. What is None or False is absent, unless `whole`, which `from_dict` needs."""
        values = asdict(self)
        if whole:
            return values
        return {name: value for name, value in values.items() if value is not None and value is not False}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Plan:
        """The plan whose `as_dict(whole=True)` was stored as JSON. Raises KeyError or TypeError for other fields."""
        course = dict(values["schedule"])
        course["budget"] = Budget(**course["budget"])
        course["annealing"] = Annealing(**course["annealing"])
        course["resolution"] = tuple((first, factor) for first, factor in course["resolution"])
        fields = {**values, "schedule": Schedule(**course), "forced": tuple(values["forced"])}
        return Plan(**fields)

    @staticmethod
    def gaussians_within(memory: int, used: int = 0, *, best: bool = True) -> int:
        """Number of Gaussians that `memory` bytes hold beside the photos and the program itself; at least 1000.

        used: bytes that these are known to have, where that is more than BYTES_OF_PROGRAM.
        best: whether the best snapshot is kept too.
        """
        each = BYTES_PER_GAUSSIAN + (BYTES_OF_BEST if best else 0)
        return max(1000, (memory - max(used, BYTES_OF_PROGRAM)) // each)

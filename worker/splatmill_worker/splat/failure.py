"""Numerical failures, by name: what happened, what was seen, what to do."""

from __future__ import annotations

from enum import StrEnum


class FailureName(StrEnum):
    """Every way in which training ends without a model that can be trusted."""

    non_finite = "non_finite"
    divergence = "divergence"
    empty_scene = "empty_scene"
    memory = "memory"


ADVICE = {
    FailureName.non_finite: "The cameras or points may hold extreme values; look at the reconstruction first.",
    FailureName.divergence: "The cameras probably do not fit the photos; check their poses, or take more photos.",
    FailureName.empty_scene: "Nothing that the photos show could be kept; check the masks and the camera poses.",
    FailureName.memory: "Set a smaller image_size or max_gaussians.",
}


class TrainingFailed(Exception):
    """Training stopped by name. `last_good` says whether a usable state was rolled back to."""

    def __init__(self, name: FailureName, seen: str, *, step: int) -> None:
        super().__init__(f"Training stopped at step {step}: {seen} {ADVICE[name]}")
        self.name = name
        self.seen = seen
        self.step = step

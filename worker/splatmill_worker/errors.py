"""The errors that end the work on a capture, in one tree.

    WorkerError              code, message, facts, advice
    ├── Refusal              the job cannot be done as it was asked for
    │   ├── NothingUploaded  the capture holds no file
    │   ├── ModelNotStored   the model to start from is not in storage
    │   └── StartUnusable    the file to start from is no 3D Gaussian model
    ├── SfmFailed            structure from motion ended without a usable scene
    ├── TrainingFailed       the optimisation ended by a numerical failure
    └── ModelUnreadable      a stored .ply file cannot be read

    Cancelled                the caller asked to stop; nothing is wrong

`code` is one of `splatmill.schema.PROBLEMS`, so that each error becomes a problem document without a second table.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, ClassVar


class WorkerError(Exception):
    """A failure with everything that a person needs to act on it.

    code: stable name, one of `splatmill.schema.PROBLEMS`.
    message: what happened and what was seen, one sentence.
    facts: the figures and names behind the message.
    advice: what to do about it; None where the kind of problem says it all.
    """

    def __init__(
        self, code: str, message: str, *, facts: dict[str, Any] | None = None, advice: str | None = None
    ) -> None:
        super().__init__(f"{message} {advice}" if advice else message)
        self.code = code
        self.message = message
        self.facts = facts or {}
        self.advice = advice


class Refusal(WorkerError):
    """The job cannot be done as it was asked for: an option, the poses, or a file given with the photos."""


class NothingUploaded(Refusal):
    """The capture holds no file."""

    def __init__(self, capture_id: str) -> None:
        super().__init__(
            "no_images",
            f"The capture {capture_id} holds no files.",
            advice="Upload the photos to the capture before creating a job.",
        )


class ModelNotStored(Refusal):
    """The model to start from is not, or no longer, in storage."""

    def __init__(self, model_id: str) -> None:
        super().__init__(
            "model_not_found",
            f"The model {model_id[:80]!r} to start from is not stored.",
            advice="Start from another model, or leave start out.",
        )


class StartUnusable(Refusal):
    """The file to start from is no 3D Gaussian model, or holds nothing that the cameras show."""

    def __init__(self, message: str) -> None:
        super().__init__(
            "start_unusable",
            message,
            advice="Give a 3D Gaussian .ply that was trained on cameras of the same capture, or leave start out.",
        )


class SfmFailed(WorkerError):
    """Structure from motion ended without a usable scene.

    `code` is one of no_images, too_few_images, sfm_no_features, sfm_too_few_registered, sfm_no_parallax, sfm_failed.
    """

    def __init__(self, code: str, message: str, facts: dict[str, Any], advice: str) -> None:
        super().__init__(code, message, facts=facts, advice=advice)


class FailureName(StrEnum):
    """Every way in which training ends without a model that can be trusted."""

    non_finite = "non_finite"
    divergence = "divergence"
    empty_scene = "empty_scene"
    memory = "memory"


class TrainingFailed(WorkerError):
    """The optimisation stopped at `step` by a numerical failure.

    name: which failure.
    seen: what was observed, one sentence.
    step: number of the training step, 1-based.
    """

    CODES: ClassVar[dict[FailureName, str]] = {
        FailureName.non_finite: "non_finite",
        FailureName.divergence: "diverged",
        FailureName.empty_scene: "empty_scene",
        FailureName.memory: "out_of_memory",
    }
    ADVICE: ClassVar[dict[FailureName, str]] = {
        FailureName.non_finite: "The cameras or points may hold extreme values; look at the reconstruction first.",
        FailureName.divergence: "The cameras probably do not fit the photos; check their poses, or take more photos.",
        FailureName.empty_scene: "Nothing that the photos show could be kept; check the masks and the camera poses.",
        FailureName.memory: "Set a smaller image_size or max_gaussians.",
    }

    def __init__(self, name: FailureName, seen: str, *, step: int) -> None:
        super().__init__(
            self.CODES[name],
            f"Training stopped at step {step}: {seen}",
            facts={"step": step},
            advice=self.ADVICE[name],
        )
        self.name = name
        self.seen = seen
        self.step = step


class ModelUnreadable(WorkerError):
    """A .ply file that is damaged or is no 3D Gaussian scene."""

    def __init__(self, message: str) -> None:
        super().__init__("model_corrupt", message)


class Cancelled(Exception):
    """The caller asked to stop. Nothing is wrong, and the work can go on later from what was kept."""

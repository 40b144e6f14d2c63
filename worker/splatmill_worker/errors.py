"""The errors of the worker that a user can act on, in one tree.

    WorkerError              code, message, facts, advice
    ├── Refusal              the job cannot be done as it was requested
    │   ├── EmptyCapture     the capture has no files
    │   ├── StartNotStored   the model to start from is not in storage
    │   ├── StartUnusable    the file to start from is not a usable 3D Gaussian model
    │   ├── UnusablePicture  a picture cannot be read, or exceeds a limit
    │   └── UnusableVideo    a video cannot be read, or exceeds a limit
    ├── CaptureIncomplete    files of the capture did not reach the training
    ├── SfmFailed            structure from motion ended without a usable scene
    ├── TrainingFailed       training ended with a numerical failure
    ├── DecoderNotStarted    no process that decodes files can be started
    ├── ModelNotFound        there is no finished model with the requested id
    ├── ModelUnreadable      a model file cannot be read as 3D Gaussians, or is of an unknown format
    ├── QuotaReached         the owner has no room left for what the job stores or unpacks
    ├── FolderInUse          another process works in the job's folder
    └── DiskReserveReached   the worker's disk is full but for the reserve

    Cancelled                the caller requested to stop; not a failure

Each code is one of `splatmill.schema.PROBLEMS`. `WorkerError.problem` is the one place that makes a problem document
from these errors; `service/attempts/problems.py` adds those of storage, Redis and the operating system.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from splatmill.schema.quantities import format_bytes

if TYPE_CHECKING:
    from splatmill.schema import Problem


class WorkerError(Exception):
    """A failure, with all that a user needs to act on it.

    code: stable name of the kind of failure, one of `splatmill.schema.PROBLEMS`.
    message: what happened and what was seen, as a sentence.
    facts: the numbers and names that the message is based on.
    advice: what to do; None where the kind of failure makes it clear.
    """

    def __init__(
        self, code: str, message: str, *, facts: dict[str, Any] | None = None, advice: str | None = None
    ) -> None:
        super().__init__(f"{message} {advice}" if advice else message)
        self.code = code
        self.message = message
        self.facts = facts or {}
        self.advice = advice

    def problem(self) -> Problem:
        """Return the problem document for this failure."""
        # Imported here, because the processes that decode photos need no documents.
        from splatmill.schema import Problem

        return Problem.of(self.code, self.message, facts=self.facts, advice=self.advice)


class Refusal(WorkerError):
    """The job cannot be done as it was requested: an option, the poses, or an uploaded file does not permit it."""


class EmptyCapture(Refusal):
    """The capture has no files."""

    def __init__(self, capture_id: str) -> None:
        super().__init__(
            "no_images",
            f"The capture {capture_id} has no files.",
            advice="Upload the photos to the capture before creating a job.",
        )


class StartNotStored(Refusal):
    """The model to start from is not in storage, or was deleted."""

    def __init__(self, model_id: str) -> None:
        super().__init__(
            "model_not_found",
            f"The model to start from, {model_id[:80]!r}, is not in storage.",
            advice="Start from another model, or leave out the option start.",
        )


class StartUnusable(Refusal):
    """The file to start from is not a 3D Gaussian model, or the cameras see nothing of it."""

    def __init__(self, message: str) -> None:
        super().__init__(
            "start_unusable",
            message,
            advice=(
                "Start from a 3D Gaussian model that was trained on the cameras of this capture, "
                "or leave out the option start."
            ),
        )


class UnusablePicture(Refusal):
    """A picture cannot be read, or exceeds a limit.

    code: file_empty, not_an_image, image_truncated, image_too_small, image_too_large or decoder_ended.
    reason: what is wrong with it, as a part of a sentence.
    """

    def __init__(self, code: str, name: str, reason: str) -> None:
        super().__init__(
            code,
            f"{name}: {reason}.",
            facts={"file": name},
            advice="Leave the file out, or give it as a whole JPEG, PNG, WebP, TIFF, HEIC or AVIF picture.",
        )
        self.reason = reason


class UnusableVideo(Refusal):
    """A video cannot be read, or exceeds a limit; `reason` is a part of a sentence."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(
            "video_unreadable",
            f"{name}: {reason}.",
            facts={"file": name},
            advice="Leave the file out, or give it as an MP4 video.",
        )
        self.reason = reason


class CaptureIncomplete(WorkerError):
    """Files of the capture did not reach the training, and no reason for leaving them out is known."""

    def __init__(self, place: str, missing: list[str], count: int) -> None:
        super().__init__(
            "capture_incomplete",
            f"{len(missing)} of the {count} files of {place} did not reach the training, such as {missing[0]!r}.",
            facts={"missing": missing[:20], "files": count},
            advice="Check that the capture is whole and that the worker may read the storage, then restart the job.",
        )


class SfmFailed(WorkerError):
    """Structure from motion ended without a usable scene.

    `code` is one of no_images, too_few_images, sfm_no_features, sfm_too_few_registered, sfm_no_parallax, sfm_failed.
    """

    def __init__(self, code: str, message: str, facts: dict[str, Any], advice: str) -> None:
        super().__init__(code, message, facts=facts, advice=advice)


class FailureName(StrEnum):
    """The numerical failures that end a training.

    non_finite: the loss or a parameter became infinite or NaN.
    divergence: the smoothed loss rose to a multiple of its lowest value.
    empty_scene: no Gaussians were left, or the views saw none of them.
    memory: too little memory was left to go on.
    """

    non_finite = "non_finite"
    divergence = "divergence"
    empty_scene = "empty_scene"
    memory = "memory"


class TrainingFailed(WorkerError):
    """Training ended with a numerical failure.

    name: which failure.
    symptom: what was observed, as the end of a sentence.
    step: number of the training step, from 1.
    """

    CODES: ClassVar[dict[FailureName, str]] = {
        FailureName.non_finite: "non_finite",
        FailureName.divergence: "diverged",
        FailureName.empty_scene: "empty_scene",
        FailureName.memory: "out_of_memory",
    }
    ADVICE: ClassVar[dict[FailureName, str]] = {
        FailureName.non_finite: (
            "The cameras or points probably have extreme values: check the reconstruction or the given poses."
        ),
        FailureName.divergence: (
            "The cameras probably do not fit the photos: check their poses, or take more photos."
        ),
        FailureName.empty_scene: "Check the masks and the camera poses: no Gaussian agreed with the photos.",
        FailureName.memory: "Set a smaller image_size or max_gaussians.",
    }

    def __init__(self, name: FailureName, symptom: str, *, step: int) -> None:
        super().__init__(
            self.CODES[name],
            f"Training stopped at step {step}: {symptom}",
            facts={"step": step},
            advice=self.ADVICE[name],
        )
        self.name = name
        self.symptom = symptom
        self.step = step


class DecoderNotStarted(WorkerError):
    """No process that decodes the files of a capture can be started; `how` says how the last one ended."""

    def __init__(self, how: str) -> None:
        super().__init__(
            "decoder_ended",
            f"No process that decodes photos could be started: {how}.",
            advice="Run `splatmill doctor` on the worker's machine, then restart the job.",
        )


class ModelNotFound(WorkerError):
    """There is no finished model with this id."""

    def __init__(self, model_id: str) -> None:
        super().__init__("model_not_found", f"There is no finished model {model_id[:80]!r}.")


class ModelUnreadable(WorkerError):
    """A model file is damaged, of a format that is not read or written, or no 3D Gaussian model."""

    def __init__(self, message: str) -> None:
        super().__init__("model_corrupt", message)


class FolderInUse(WorkerError):
    """Another process works in the job's folder, although the job's lock is free."""

    def __init__(self, folder: Path) -> None:
        super().__init__(
            "worker_lost",
            f"Another process works in the job's folder {folder}.",
            advice="End the process that was left over on the worker's machine, then restart the job.",
        )


class QuotaReached(WorkerError):
    """The owner has no room left for what the job stores or unpacks. What the attempt has stored is kept.

    used, limit, size: bytes that are used, that the owner may have, and that the job needs.
    """

    def __init__(self, owner: str, used: int, limit: int, size: int) -> None:
        super().__init__(
            "quota_exceeded",
            f"The owner {owner} has {format_bytes(used)} of {format_bytes(limit)} in storage, and the job needs "
            f"{format_bytes(size)}.",
            facts={"used": used, "limit": limit, "size": size},
            advice="Delete captures or jobs that are no longer needed, then restart the job.",
        )


class DiskReserveReached(WorkerError):
    """The worker's disk is full but for the reserve. What the attempt has stored is kept, and a restart continues.

    folder: the worker's data folder.
    free, reserve, needed: bytes that are free, that stay free, and that were to be written.
    """

    def __init__(self, folder: Path, free: int, reserve: int, needed: int) -> None:
        need = f", and {format_bytes(needed)} more are needed" if needed else ""
        super().__init__(
            "worker_disk_full",
            f"The disk of the worker's data folder {folder} has {format_bytes(free)} left{need}; "
            f"{format_bytes(reserve)} stay free.",
            facts={"free": free, "reserve": reserve, "needed": needed},
            advice="Free space on that disk, then restart the job: it continues from its last checkpoint.",
        )
        self.folder = folder
        self.free = free
        self.reserve = reserve


class Cancelled(Exception):
    """The caller requested to stop. This is not a failure: the work can be resumed from what was stored."""

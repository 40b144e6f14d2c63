"""The events that a worker reports about an attempt at a job: the whole protocol, as one union.

An event does not depend on where it is stored. `EventRecord` adds its id, the attempt and the time.
"""

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from splatmill.schema.base import Measured, Response, Time
from splatmill.schema.problems import Problem


class JobState(StrEnum):
    """The states of a job, in order; the last three are final."""

    queued = "queued"
    preparing = "preparing"
    sfm = "sfm"
    training = "training"
    exporting = "exporting"
    succeeded = "succeeded"
    failed = "failed"
    cancelled = "cancelled"

    @property
    def final(self) -> bool:
        """Whether no other state follows."""
        return self in FINAL_STATES


FINAL_STATES = frozenset({JobState.succeeded, JobState.failed, JobState.cancelled})


class Progress(Response):
    """Progress of one stage of an attempt. A value that the stage does not measure is null."""

    stage: str = Field(max_length=64, description="Name of the stage: features, matching, training, ...")
    done: int = Field(default=0, ge=0, description="Number of units of the stage that are done.")
    total: int | None = Field(
        default=None, ge=0, description="Number of units in the stage; null where it is not known."
    )
    note: str | None = Field(default=None, max_length=2000, description="What is worked on, for people.")
    step: int | None = Field(default=None, ge=0, description="Training steps done.")
    loss: Measured = None
    psnr: Measured = Field(
        default=None, description="Mean over the held-out photos when last measured, in dB."
    )
    ssim: Measured = Field(default=None, description="Mean over the held-out photos when last measured.")
    gaussians: int | None = Field(default=None, ge=0, description="Number of Gaussians.")
    seconds: Measured = Field(default=None, description="Seconds spent in this stage.")
    eta: Measured = Field(default=None, description="Estimated seconds until the stage ends.")
    at_most: bool | None = Field(
        default=None,
        description="Whether `total` and `eta` are bounds: the stage ends where more gains too little.",
    )


class CurveRow(Response):
    """One measurement of error against run time. The training clock is stopped while it is taken."""

    seconds: float = Field(ge=0, description="Training time in seconds.")
    step: int = Field(ge=0, description="Training steps done.")
    loss: Measured = Field(default=None, description="Training loss.")
    psnr: Measured = Field(default=None, description="Mean over the held-out photos, in dB.")
    ssim: Measured = Field(default=None, description="Mean over the held-out photos.")
    gaussians: int = Field(ge=0, description="Number of Gaussians.")
    memory: int | None = Field(default=None, ge=0, description="Resident memory of the process, in bytes.")
    train_psnr: Measured = Field(default=None, description="Mean over some of the training photos, in dB.")
    train_ssim: Measured = Field(default=None, description="Mean over some of the training photos.")


class Curve(Response):
    """The response of `/v1/jobs/{id}/curve`, by step."""

    rows: list[CurveRow]


class StateEvent(Response):
    """The job entered a state. `problem` is the reason for the state failed."""

    type: Literal["state"] = "state"
    state: JobState
    problem: Problem | None = None


class ProgressEvent(Progress):
    """New progress of a stage."""

    type: Literal["progress"] = "progress"


class MetricEvent(CurveRow):
    """A new measurement of error against run time."""

    type: Literal["metric"] = "metric"


class LogEvent(Response):
    """A log line."""

    type: Literal["log"] = "log"
    level: Literal["debug", "info", "warning", "error"] = "info"
    message: str = Field(max_length=20_000)
    about: str | None = Field(
        default=None, description="unused_photos: photos that the job's cameras list as unused, too."
    )


class PreviewEvent(Response):
    """A new preview image of the scene was stored."""

    type: Literal["preview"] = "preview"
    path: str = Field(
        description="Path of the image, relative to the storage root or to the job's work folder."
    )
    step: int | None = Field(default=None, ge=0, description="Training steps done.")


class CamerasEvent(Response):
    """Cameras were placed: some of them while structure from motion runs, or all of them when it has ended."""

    type: Literal["cameras"] = "cameras"
    path: str = Field(
        description="Path of the `Placement`, relative to the storage root or to the job's work folder. Clients get "
        "it from `/v1/jobs/{id}/cameras`."
    )
    cameras: int = Field(ge=0, description="Number of photos that have a camera.")
    points: int = Field(ge=0, description="Number of points of the whole scene.")
    final: bool = Field(default=False, description="Whether training uses these cameras.")


class SnapshotEvent(Response):
    """A new snapshot of the scene in training can be fetched from `/v1/jobs/{id}/snapshot`, for some time."""

    type: Literal["snapshot"] = "snapshot"
    step: int = Field(ge=0, description="Training steps done.")
    seconds: float = Field(ge=0, description="Training time in seconds.")
    gaussians: int = Field(ge=0, description="Number of Gaussians of the scene.")
    shown: int = Field(ge=0, description="Number of Gaussians in the snapshot.")
    bytes: int = Field(ge=0, description="Size of the snapshot in bytes.")


class UnitEvent(Response):
    """A unit of a scene in tiles began or ended: a part of the search for cameras, the cameras, the coarse model, a
    tile or its last steps, or the whole."""

    type: Literal["unit"] = "unit"
    unit: str = Field(
        max_length=64,
        description="Name of the unit: photos, features-1, ..., pairs, matches-1, ..., mapping-1, ..., cameras, "
        "coarse, tile-1, ..., seam-1, ..., scene.",
    )
    state: Literal["running", "elsewhere", "done", "failed"] = Field(
        description="elsewhere: another worker had it when that of the job looked, between two of its units. What is "
        "running or elsewhere when an attempt ends was not finished."
    )
    tiles: int = Field(ge=1, description="Number of tiles of the scene.")
    seconds: Measured = Field(default=None, description="Seconds that the unit took.")
    photos: int | None = Field(default=None, ge=0, description="Number of photos that it was trained on.")
    gaussians: int | None = Field(default=None, ge=0, description="Number of Gaussians that it left.")


class PlanEvent(Response):
    """The plan of the training: what is done and what is left out, each with the fact that decided it."""

    type: Literal["plan"] = "plan"
    plan: dict[str, Any]


Event = Annotated[
    StateEvent
    | ProgressEvent
    | MetricEvent
    | LogEvent
    | PreviewEvent
    | PlanEvent
    | CamerasEvent
    | SnapshotEvent
    | UnitEvent,
    Field(discriminator="type"),
]

EVENT: TypeAdapter[Event] = TypeAdapter(Event)
"""Parses an event: `EVENT.validate_json(text)`."""


class EventRecord(Response):
    """An event with its id, attempt and time, as it is streamed to clients."""

    id: str = Field(
        description="Position in the job's events. Send it as Last-Event-ID to resume after this event."
    )
    attempt: int = Field(
        ge=0, description="Number of the attempt that reported it; 0 for the service itself."
    )
    at: Time
    event: Event

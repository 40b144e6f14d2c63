"""What a worker tells about an attempt: the whole protocol, one union.

The payloads know nothing of where they are stored. The envelope `EventRecord` adds id, attempt and time.
"""

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from splatmill.schema.base import Measured, Response, Time
from splatmill.schema.problems import Problem


class JobState(StrEnum):
    """The life of a job, in order; the last three are final."""

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
        """Whether nothing follows."""
        return self in FINAL_STATES


FINAL_STATES = frozenset({JobState.succeeded, JobState.failed, JobState.cancelled})


class Progress(Response):
    """How far an attempt has come. What a stage does not measure is absent."""

    stage: str = Field(max_length=64, description="What is being done: features, matching, training, ...")
    done: int = Field(default=0, ge=0, description="How many units of the stage are done.")
    total: int | None = Field(
        default=None, ge=0, description="How many there are; absent where it is not known."
    )
    note: str | None = Field(default=None, max_length=2000)
    step: int | None = Field(default=None, ge=0, description="Training step.")
    loss: Measured = None
    psnr: Measured = Field(default=None, description="dB, on held-out views when last measured.")
    ssim: Measured = None
    gaussians: int | None = Field(default=None, ge=0)
    seconds: Measured = Field(default=None, description="Seconds spent in this stage.")
    eta: Measured = Field(default=None, description="Seconds until the stage ends, estimated.")


class CurveRow(Response):
    """One point of error against run time, measured with the training clock stopped. Psnr, ssim: on held-out views."""

    seconds: float = Field(ge=0, description="Training seconds.")
    step: int = Field(ge=0)
    loss: Measured = None
    psnr: Measured = None
    ssim: Measured = None
    gaussians: int = Field(ge=0)
    memory: int | None = Field(default=None, ge=0, description="Bytes that the attempt's process holds.")
    train_psnr: Measured = Field(default=None, description="dB, on a few of the views that were trained on.")
    train_ssim: Measured = None


class StateEvent(Response):
    """The attempt entered a state. A failure says why."""

    type: Literal["state"] = "state"
    state: JobState
    problem: Problem | None = None


class ProgressEvent(Progress):
    """How far the attempt has come."""

    type: Literal["progress"] = "progress"


class MetricEvent(CurveRow):
    """A new point of the curve."""

    type: Literal["metric"] = "metric"


class LogEvent(Response):
    """A line for people."""

    type: Literal["log"] = "log"
    level: Literal["debug", "info", "warning", "error"] = "info"
    message: str = Field(max_length=20_000)


class PreviewEvent(Response):
    """A new preview picture of the scene was stored."""

    type: Literal["preview"] = "preview"
    path: str = Field(description="Where it is stored, relative to the storage root (or the work folder).")
    step: int | None = Field(default=None, ge=0)


class PlanEvent(Response):
    """What the trainer decided to do and to leave out; each entry carries the fact that decided it."""

    type: Literal["plan"] = "plan"
    plan: dict[str, Any]


Event = Annotated[
    StateEvent | ProgressEvent | MetricEvent | LogEvent | PreviewEvent | PlanEvent,
    Field(discriminator="type"),
]

EVENT: TypeAdapter[Event] = TypeAdapter(Event)
"""Reads an event: `EVENT.validate_json(text)`."""


class EventRecord(Response):
    """An event as it is stored and streamed."""

    id: str = Field(description="Grows within a job; send it back as Last-Event-ID to go on after it.")
    attempt: int = Field(ge=0, description="Which attempt said it; 0 is the service itself.")
    at: Time
    event: Event

"""How long a job will probably take, from the jobs that a server has finished."""

from typing import Literal

from pydantic import Field

from splatmill.schema.base import Request, Response
from splatmill.schema.options import TrainOptions


class EstimateJob(Request):
    """A request for the time that a job would take. Nothing is created."""

    photos: int = Field(ge=1, le=100_000, description="Number of photos, with those taken from videos.")
    exact: bool = Field(
        default=True,
        description="Whether that number is certain, as it is for photos. The frames of a video, and the photos in an "
        "archive, are counted in the course of the job. A time for the whole job that is too short for the photos is "
        "refused where it is certain.",
    )
    posed: bool = Field(default=False, description="Whether the cameras come with the photos.")
    capture: str | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Id of the capture that holds the photos, where there is one: its cameras may be known from an "
        "earlier job.",
    )
    options: TrainOptions = Field(default_factory=TrainOptions)


class StageEstimate(Response):
    """The time of one part of a job. The numbers are null where there is nothing to derive them from."""

    stage: Literal["cameras", "training", "rest"] = Field(
        description="cameras: their recovery from the photos. training: the steps. rest: start, loading, measuring and "
        "storing."
    )
    seconds: float | None = Field(default=None, ge=0, description="The median of what the jobs lead to.")
    lowest: float | None = Field(
        default=None, ge=0, description="The least that one of the jobs leads to, in seconds."
    )
    highest: float | None = Field(
        default=None, ge=0, description="The most that one of the jobs leads to, in seconds."
    )
    because: str = Field(description="What it was derived from, in one sentence.")


class Estimate(Response):
    """How long a job will probably take once a worker has taken it.

    The sums are null if one of the stages is.
    """

    seconds: float | None = Field(default=None, ge=0, description="Sum over the stages.")
    lowest: float | None = Field(default=None, ge=0, description="Sum of the lowest values, in seconds.")
    highest: float | None = Field(default=None, ge=0, description="Sum of the highest values, in seconds.")
    stages: list[StageEstimate]
    jobs: int = Field(ge=0, description="Number of finished jobs that it was derived from.")
    machine: str | None = Field(default=None, description="The machine that ran them.")

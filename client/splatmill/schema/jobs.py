"""Jobs: what is asked for, and what a client sees of it."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from splatmill.schema.base import Request, Response, Time
from splatmill.schema.events import JobState, LogEvent, Progress
from splatmill.schema.options import TrainOptions
from splatmill.schema.problems import Problem

IDEMPOTENCY_HEADER = "Idempotency-Key"
"""Two requests to create a job with the same key make one job."""


class CreateJob(Request):
    """Train a capture."""

    capture: str = Field(min_length=1, max_length=64, description="The capture's id.")
    name: str | None = Field(default=None, max_length=200, description="A name for people.")
    options: TrainOptions = Field(default_factory=TrainOptions)


def _known_options(value: Any) -> Any:
    # A newer server may have settings that this version does not know; reading its jobs must not fail.
    if isinstance(value, dict):
        return {name: kept for name, kept in value.items() if name in TrainOptions.model_fields}
    return value


class Job(Response):
    """A job as a client sees it: the request, the wishes, and what the attempts told."""

    id: str
    capture: str
    name: str | None = None
    state: JobState
    options: Annotated[TrainOptions, BeforeValidator(_known_options)]
    created_at: Time
    started_at: Time | None = None
    finished_at: Time | None = None
    attempt: int = Field(default=0, ge=0, description="How many attempts have begun.")
    cancel_requested: bool = False
    progress: Progress | None = None
    plan: dict[str, Any] | None = Field(default=None, description="What the trainer decided, with reasons.")
    problem: Problem | None = Field(default=None, description="Why the job failed.")
    model: str | None = Field(default=None, description="The finished model's id.")
    links: dict[str, str] = Field(default_factory=dict, description="Addresses, relative to the server.")


class JobPage(Response):
    """Jobs, newest first."""

    jobs: list[Job]
    cursor: str | None = Field(
        default=None, description="Send it back as ?cursor= for the next page; null on the last."
    )


class LogLine(LogEvent):
    """A line of a job's log with its attempt and time."""

    attempt: int = Field(ge=0)
    at: Time


class LogPage(Response):
    """What `/v1/jobs/{id}/logs` answers, oldest first."""

    lines: list[LogLine]

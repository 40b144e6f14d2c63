"""Jobs: the request that creates one, and its record as clients see it."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from splatmill.schema.base import Label, Request, Response, Time
from splatmill.schema.options import TrainOptions
from splatmill.schema.problems import Problem
from splatmill.schema.resources.access import DEFAULT_OWNER, Owner
from splatmill.schema.resources.jobs.events import JobState, LogEvent, Progress
from splatmill.schema.tolerant import keep_readable

IDEMPOTENCY_HEADER = "Idempotency-Key"
"""Request header. Requests to create a job that carry the same key create one job."""


class CreateJob(Request):
    """A request to train a capture."""

    capture: str = Field(min_length=1, max_length=64, description="Id of the capture.")
    name: Label | None = Field(default=None, description="A name to recognise the job by.")
    options: TrainOptions = Field(default_factory=TrainOptions)
    priority: int = Field(
        default=0,
        ge=-100,
        le=100,
        description="Of the jobs of one owner, those with a higher priority are run first. Jobs of other owners "
        "are not affected.",
    )

    def described(self, *, with_capture: bool = True) -> str:
        """Return the request as JSON, by which a repeated request is known to be the same.

        Values that are the default are left out, so that it is the same to a later version, which has more options.
        """
        return self.model_dump_json(exclude=None if with_capture else {"capture"}, exclude_defaults=True)


def _readable_options(value: Any) -> Any:
    # A newer server may have options, or values of options, that this version does not know; its jobs, and the
    # records that it stored, must still be readable.
    return keep_readable(TrainOptions.model_validate, value)[0] if isinstance(value, dict) else value


def _named_state(value: Any) -> Any:
    # A newer server may have states that this version does not know; they are named as they are, and are not final.
    if not isinstance(value, str) or value in set(JobState):
        return value
    state = str.__new__(JobState, value)
    state._name_, state._value_ = value, value
    return state


class Job(Response):
    """A job as clients see it: the request, its state, and what its attempts reported."""

    id: str
    capture: str
    name: str | None = None
    tags: list[str] = Field(default_factory=list, description="Words that it was given, also to its model.")
    favourite: bool = Field(default=False, description="Whether it has a star, as its model has.")
    owner: Owner = DEFAULT_OWNER
    state: Annotated[JobState, BeforeValidator(_named_state)]
    options: Annotated[TrainOptions, BeforeValidator(_readable_options)]
    priority: int = Field(default=0, description="Jobs of the owner with a higher priority are run first.")
    queue_position: int | None = Field(
        default=None,
        ge=0,
        description="Number of jobs that are run before it, as things stand; null once it was taken by a worker.",
    )
    estimated_start: Time | None = Field(
        default=None,
        description="When a worker will probably take it, from how long the last jobs of its queue took; null where "
        "that is not known.",
    )
    waiting_for: str | None = Field(
        default=None,
        description="The queue that it waits in while no worker serves that queue: any, cpu or gpu. It runs once such "
        "a worker is started.",
    )
    created_at: Time
    started_at: Time | None = None
    finished_at: Time | None = None
    attempt: int = Field(default=0, ge=0, description="Number of attempts that have begun.")
    cancel_requested: bool = Field(default=False, description="Whether a client has asked to cancel it.")
    progress: Progress | None = None
    plan: dict[str, Any] | None = Field(
        default=None, description="What was decided for the training, with the reasons."
    )
    problem: Problem | None = Field(default=None, description="Why the job failed.")
    model: str | None = Field(default=None, description="Id of the finished model.")
    links: dict[str, str] = Field(
        default_factory=dict, description="Addresses of what belongs to the job, on the server's host."
    )


class JobPage(Response):
    """A page of jobs."""

    jobs: list[Job]
    cursor: str | None = Field(
        default=None, description="Send it as ?cursor= to get the next page; null on the last page."
    )


class LogLine(LogEvent):
    """A line of a job's log with its attempt and time."""

    attempt: int = Field(ge=0)
    at: Time


class LogPage(Response):
    """The response of `/v1/jobs/{id}/logs`, oldest line first."""

    lines: list[LogLine]

"""Orbit videos that the server renders in the background and keeps with their model."""

from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from splatmill.schema.base import Request, Response, Time
from splatmill.schema.ids import ID
from splatmill.schema.problems import Problem
from splatmill.schema.videos import OrbitRequest


class OrbitState(StrEnum):
    """Where an orbit video stands."""

    queued = "queued"
    running = "running"
    succeeded = "succeeded"
    failed = "failed"

    @property
    def final(self) -> bool:
        """Whether nothing follows this state, unless the video is asked for again."""
        return self in (OrbitState.succeeded, OrbitState.failed)


def _known(request: Any) -> Any:
    """Leave out what a newer server added, which `Request` would refuse."""
    if not isinstance(request, dict):
        return request
    return {name: value for name, value in request.items() if name in OrbitRequest.model_fields}


class Orbit(Response):
    """An orbit video of a model: what was asked for, and how far it is."""

    id: str = Field(description="The same for the same request on the same model.")
    model: str
    request: Annotated[OrbitRequest, BeforeValidator(_known)]
    state: OrbitState
    frames: int = Field(ge=1, description="Number of frames of the whole video.")
    frames_done: int = Field(default=0, ge=0, description="Frames that are rendered and stored.")
    created_at: Time
    finished_at: Time | None = None
    bytes: int | None = Field(default=None, ge=0, description="Size of the video; null until it is whole.")
    problem: Problem | None = Field(default=None, description="Why the rendering failed.")
    links: dict[str, str] = Field(default_factory=dict, description="Related addresses.")


class OrbitList(Response):
    """The orbit videos of a model, newest first."""

    orbits: list[Orbit]


class OrbitFrames(Request):
    """The request to the renderer for some frames of an orbit video."""

    orbit: OrbitRequest
    first: int = Field(ge=0, description="Number of the first frame, from 0.")
    count: int = Field(ge=1, description="Number of frames.")

    @model_validator(mode="after")
    def _of_the_video(self) -> Self:
        if self.first + self.count > self.orbit.frames:
            raise ValueError(
                f"{self.count} frames from {self.first} on are asked for, and the video has {self.orbit.frames}"
            )
        return self


class JoinOrbit(Request):
    """The request to the renderer to make one video of all stored frames of an orbit."""

    orbit: str = Field(pattern=f"^{ID.pattern}$", description="Id of the orbit.")
    frames: int = Field(ge=1, description="Number of frames that it must have.")

"""Orbit videos that the server renders in the background and keeps with their model."""

from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from splatmill.schema.base import Request, Response
from splatmill.schema.ids import ID
from splatmill.schema.resources.models.kept import Kept, known
from splatmill.schema.videos import OrbitRequest


class Orbit(Kept):
    """An orbit video of a model: what was asked for, and how far it is."""

    request: Annotated[OrbitRequest, BeforeValidator(known(OrbitRequest))]
    frames: int = Field(ge=1, description="Number of frames of the whole video.")
    frames_done: int = Field(default=0, ge=0, description="Frames that are rendered and stored.")


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

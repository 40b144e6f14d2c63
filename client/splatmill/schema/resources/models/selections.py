"""Selections of Gaussians: lines that people drew on views of a model, by which an edit knows what it leaves out.

A selection is sent as the lines and not as indices, so that it has some kilobytes for any number of Gaussians.
"""

from typing import Annotated

from pydantic import Field, model_validator

from splatmill.schema.base import Request
from splatmill.schema.cameras import Matrix, check_rigid

MOST_STROKES = 64
MOST_POINTS = 256

Slope = Annotated[float, Field(ge=-1e6, le=1e6)]
"""A coordinate on the plane at distance 1 before a camera: x / z or y / z in its OpenCV axes."""


class Stroke(Request):
    """A line that was drawn on one view: a brush of some radius along it, or a closed line around an area.

    It holds the Gaussians whose centres are seen there, also those behind others.
    """

    camera_to_world: Matrix = Field(description="Pose of the view, 4x4, row-major, with OpenCV axes.")
    points: list[tuple[Slope, Slope]] = Field(
        min_length=1,
        max_length=MOST_POINTS,
        description="The line, as x / z and y / z in the coordinates of the view.",
    )
    radius: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        description="Radius of the brush, in the unit of `points`; null for a closed line, whose inside counts by the "
        "even-odd rule.",
    )
    far: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="Largest distance along the viewing direction, in units of the model; null for none.",
    )
    subtract: bool = Field(default=False, description="Whether its Gaussians are taken out of the selection.")

    @model_validator(mode="after")
    def _drawable(self) -> "Stroke":
        check_rigid(self.camera_to_world)
        if self.radius is None and len(self.points) < 3:
            raise ValueError("A closed line needs at least three points, and a brush needs a radius.")
        return self


class Selection(Request):
    """The Gaussians of some strokes, each added or taken out in turn."""

    strokes: list[Stroke] = Field(min_length=1, max_length=MOST_STROKES)
    inverted: bool = Field(default=False, description="Whether all other Gaussians are meant.")

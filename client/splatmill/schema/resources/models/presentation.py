"""How a model is shown to people: its start view, scale, measurements and annotations. Links to it show the same."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from splatmill.schema.base import Label, Request, Response, without_controls
from splatmill.schema.cameras import CameraSpec
from splatmill.schema.resources.models.edits import Point
from splatmill.schema.videos import CameraPath

POSTER = "poster.jpg"
"""The file of a model with its picture from the start view that was chosen for it."""

MOST_MARKS = 100
"""Measurements of one model, and annotations of one model."""


class Scale(Request):
    """What a length in the model is in a unit that people know."""

    factor: float = Field(
        gt=0, le=1e12, allow_inf_nan=False, description="Length in the unit of 1 in the model."
    )
    unit: Annotated[Label, Field(min_length=1, max_length=12)] = Field(
        description="Name of the unit, such as cm."
    )


class Measurement(Request):
    """The distance between two points of a model."""

    points: tuple[Point, Point] = Field(description="In the coordinates of the model.")
    name: Label | None = Field(default=None, description="What was measured.")


class Annotation(Request):
    """A text at a point of a model."""

    point: Point = Field(description="In the coordinates of the model.")
    text: Annotated[str, Field(min_length=1, max_length=500), AfterValidator(without_controls)]


class Presentation(Response):
    """How a model is shown to people, on its page, on those of its links, and in the page in one file."""

    start_view: CameraSpec | None = Field(
        default=None,
        description="Where the viewer begins. The server renders the picture of the model, poster.jpg, from there.",
    )
    background: Literal["black", "white"] = Field(default="black", description="Colour behind the model.")
    auto_rotate: bool = Field(
        default=False,
        description="Whether pages of links turn the scene slowly until somebody moves it.",
    )
    scale: Scale | None = Field(
        default=None, description="What lengths are shown in. Left out, in units of the model."
    )
    camera_path: CameraPath | None = Field(
        default=None, description="A camera path for videos, which the page of the model shows."
    )
    measurements: list[Measurement] = Field(default_factory=list, max_length=MOST_MARKS)
    annotations: list[Annotation] = Field(default_factory=list, max_length=MOST_MARKS)


class ChangePresentation(Presentation, Request):
    """A change of how a model is shown. Fields that are left out stay as they are; a list replaces the one before."""

"""Edits of a model: which Gaussians a new model leaves out."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from splatmill.schema.base import Label, Measured, Request, Response
from splatmill.schema.resources.models.selections import Selection

EDIT_HEADER = "Splatmill-Edit"
"""Response header of the renderer with an edited model: the `Edited` of it, as JSON."""

Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class Box(Request):
    """A box along the axes, in the coordinates of the model."""

    min: Point
    max: Point

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if any(low >= high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError("The box is empty: each coordinate of min must be less than that of max.")
        return self


class EditModel(Request):
    """What a new model leaves out of a model, which itself is kept. At least one thing must be asked for."""

    box: Box | None = Field(default=None, description="Gaussians whose centre is outside are left out.")
    min_opacity: float | None = Field(
        default=None, gt=0, lt=1, description="Gaussians of less opacity are left out."
    )
    max_size: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="Gaussians with a larger standard deviation along any axis are left out. In units of the model.",
    )
    selection: Selection | None = Field(
        default=None, description="Gaussians that were selected on views of the model are left out."
    )
    name: Label | None = Field(
        default=None,
        description="Name of the new model. Left out, that of the model with `, cropped` or `, cleaned` after it.",
    )
    preview: bool = Field(default=False, description="Only measure what the edit does; no model is made.")

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if all(part is None for part in (self.box, self.min_opacity, self.max_size, self.selection)):
            raise ValueError("The edit leaves nothing out: give box, min_opacity, max_size or selection.")
        return self

    @property
    def crops(self) -> bool:
        """Whether a part of the scene is left out, which the photos still show: they do not measure what is left."""
        return self.box is not None or self.selection is not None


class EditedView(Response):
    """The error of an edited model on one held-out photo."""

    name: str = Field(description="The photo's name.")
    psnr: Measured = Field(default=None, description="PSNR, in dB.")
    ssim: Measured = Field(default=None, description="SSIM.")


class Edited(Response):
    """What an edit did, or would do."""

    model: str | None = Field(default=None, description="Id of the new model; null for a preview.")
    gaussians_before: int = Field(ge=0, description="Number of Gaussians of the model.")
    gaussians: int = Field(ge=0, description="Number of Gaussians that are left.")
    crops: bool = Field(
        default=False,
        description="Whether a part of the scene is left out, which the photos still show: psnr and ssim are then no "
        "measure of what is left.",
    )
    psnr_before: Measured = Field(
        default=None, description="PSNR in dB of the model, a mean over held-out photos; null without any."
    )
    psnr: Measured = Field(default=None, description="PSNR in dB of what is left, over the same photos.")
    views: list[EditedView] = Field(
        default_factory=list, description="The held-out photos that were measured: at most 16, evenly chosen."
    )

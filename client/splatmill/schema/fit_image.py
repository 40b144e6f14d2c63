"""The options of `splatmill fit-image`: type, default, range and help text of each."""

from typing import Any

from pydantic import Field

from splatmill.schema.base import Duration, Request

_BUDGET: dict[str, Any] = {"group": "budget"}
_PHOTOS: dict[str, Any] = {"group": "photos"}
_ENGINE: dict[str, Any] = {"group": "engine"}


class FitImageOptions(Request):
    """How to fit one picture with Gaussians in a plane."""

    gaussians: int | None = Field(
        default=None,
        ge=1,
        le=2_000_000,
        description="Largest number of Gaussians. Left out, one for every 16 pixels.",
        json_schema_extra=_BUDGET,
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="Number of steps. Left out, the time budget alone ends the fit.",
        json_schema_extra=_BUDGET,
    )
    time_budget: Duration | None = Field(
        default=None,
        ge=1,
        le=86400,
        description=(
            "Time for the fit: 90s, 5m, or a number of seconds. With neither a time budget nor steps, 60s."
        ),
        json_schema_extra=_BUDGET | {"kind": "duration"},
    )
    gabor: bool = Field(
        default=False,
        description=(
            "Give half of the Gaussians a wave, a colour that swings over the picture. They are then fewer, with as "
            "many parameters in all, and show weaves and other repeated textures with less error; photos gain little. "
            "Viewers do not draw waves: the model is written as model.npz, in place of model.ply and cameras.json."
        ),
        json_schema_extra=_BUDGET,
    )
    image_size: int = Field(
        default=1024,
        ge=16,
        le=8192,
        description=(
            "Longest side of the fitted image, in pixels. A larger picture is scaled down; a smaller one is "
            "not enlarged."
        ),
        json_schema_extra=_PHOTOS,
    )
    video: bool = Field(
        default=False,
        description="Also write fit.mp4, a video of the fit.",
        json_schema_extra=_PHOTOS,
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        description=(
            "Seed of every random choice. With steps and no time budget, the same seed on the same machine "
            "gives the same bytes."
        ),
        json_schema_extra=_ENGINE,
    )

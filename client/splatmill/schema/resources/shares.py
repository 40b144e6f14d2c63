"""Links to one model for people without a key."""

from pydantic import Field

from splatmill.schema.base import Duration, Label, Measured, Request, Response, Time
from splatmill.schema.resources.models.models import ModelFile

LONGEST_SHARE = 3650 * 86400.0
"""Seconds for which a link may be valid."""


class CreateShare(Request):
    """A request for a link to a model."""

    expires_in: Duration = Field(
        default=30 * 86400.0,
        gt=0,
        le=LONGEST_SHARE,
        description="For how long the link is valid: seconds, or a text such as 90s, 12h, 30d.",
    )
    name: Label | None = Field(default=None, description="A name to recognise the link by.")
    photos: bool = Field(
        default=False,
        description="Whether the link also gives out the held-out photos, and the report as a page, which shows some.",
    )


class Share(Response):
    """A link to a model, without its token."""

    id: str
    model: str = Field(description="Id of the model that it shows.")
    name: str | None = None
    created_at: Time
    expires_at: Time
    revoked_at: Time | None = Field(default=None, description="When it was revoked.")
    photos: bool = Field(default=False, description="Whether it gives out held-out photos and the report.")
    active: bool = Field(description="Whether the link is neither revoked nor expired.")


class ShareWithToken(Share):
    """A new link. Its token is shown once."""

    token: str = Field(description="Who has it may see the model.")
    path: str = Field(description="Address of the page that shows the model, on the server's host.")


class ShareList(Response):
    """The links to a model, newest first."""

    shares: list[Share]


class SharedModel(Response):
    """What somebody with a link may know of the model."""

    id: str
    name: str | None = None
    created_at: Time
    gaussians: int = Field(ge=0, description="Number of Gaussians.")
    bytes: int = Field(ge=0, description="Size of model.ply in bytes.")
    sh_degree: int = Field(ge=0, le=3, description="Degree of the spherical harmonics.")
    antialias: bool = Field(
        default=False, description="Whether it was trained with antialiasing, and is to be drawn with it."
    )
    psnr: Measured = Field(default=None, description="Mean over the held-out photos, in dB.")
    ssim: Measured = Field(default=None, description="Mean over the held-out photos.")
    files: list[ModelFile] = Field(default_factory=list, description="The files that the link gives out.")
    expires_at: Time = Field(description="When the link ends.")

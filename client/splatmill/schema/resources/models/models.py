"""Finished models, their files and their cameras."""

from typing import Any

from pydantic import ConfigDict, Field

from splatmill.schema.base import Measured, Response, Time
from splatmill.schema.cameras import CameraSpec
from splatmill.schema.resources.access import DEFAULT_OWNER, Owner
from splatmill.schema.resources.jobs.events import CurveRow

HELD_OUT = "held_out"
"""Folder of a model's held-out photos as they were compared, `000.webp` and so on."""

TIME_LAPSE = "time_lapse"
"""Folder of a model's snapshots of its training, `000.ply` and so on."""


class ModelFile(Response):
    """A file of a model: model.ply, report.json, report.png, report.html, cameras.json, cameras.zip, frame.json,
    preview.jpg, poster.jpg, progress.mp4, the held-out photos in held_out/, and the snapshots of the training in
    time_lapse/."""

    name: str
    size: int = Field(ge=0, description="Size in bytes.")
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    media_type: str = "application/octet-stream"


class Model(Response):
    """A trained scene. Its id is that of the job that made it."""

    id: str
    job: str
    name: str | None = None
    tags: list[str] = Field(default_factory=list, description="Words that it was given, also to its job.")
    favourite: bool = Field(default=False, description="Whether it has a star, as its job has.")
    owner: Owner = DEFAULT_OWNER
    created_at: Time
    gaussians: int = Field(ge=0, description="Number of Gaussians.")
    bytes: int = Field(ge=0, description="Size of model.ply in bytes.")
    sh_degree: int = Field(ge=0, le=3, description="Degree of the spherical harmonics.")
    psnr: Measured = Field(default=None, description="Mean over the held-out photos, in dB.")
    ssim: Measured = Field(default=None, description="Mean over the held-out photos.")
    files: list[ModelFile] = Field(default_factory=list)
    links: dict[str, str] = Field(
        default_factory=dict, description="Addresses of what belongs to the model, on the server's host."
    )


class ModelPage(Response):
    """A page of models."""

    models: list[Model]
    cursor: str | None = Field(
        default=None, description="Send it as ?cursor= to get the next page; null on the last page."
    )


class ModelCamera(Response):
    """A camera of the capture in the coordinates of the model, at the size of the training photos."""

    name: str = Field(description="The photo's name.")
    split: str = Field(default="train", description="train, or test for a held-out photo.")
    camera: CameraSpec
    psnr: Measured = Field(default=None, description="PSNR of this photo, in dB.")
    psnr_color_fitted: Measured = Field(
        default=None, description="PSNR after the affine fit of the rendered colours to this photo, in dB."
    )
    ssim: Measured = Field(default=None, description="SSIM of this photo.")
    photo: str | None = Field(
        default=None,
        description="File of the model with this photo as it was compared: at the camera's size, undistorted, "
        "transparent at pixels that do not count. Only held-out photos have one, and not all where they are many.",
    )


class ModelCameras(Response):
    """The response of `/v1/models/{id}/cameras`, and the contents of cameras.json."""

    cameras: list[ModelCamera]
    up: tuple[float, float, float] | None = Field(
        default=None,
        description="Unit vector that points up in the coordinates of the model, if they were chosen when the cameras "
        "were recovered: their origin then is what the cameras look at. null where they came with the photos, and for "
        "models of versions that did not store it.",
    )


class StageSeconds(Response):
    """Duration of each stage in seconds. The training clock is stopped during evaluation."""

    model_config = ConfigDict(extra="allow")

    sfm: float = 0.0
    train: float = 0.0
    evaluate: float = 0.0


class Report(Response):
    """The contents of report.json: error against run time, the plan, and where it ran."""

    model_config = ConfigDict(extra="allow")

    format: int = Field(default=1, description="Version of the format of the report.")
    curve: list[CurveRow]
    seconds: StageSeconds
    plan: dict[str, Any] = Field(default_factory=dict)
    left_out: list[Any] = Field(default_factory=list, description="What was left out, and why.")
    versions: dict[str, Any] = Field(default_factory=dict)
    machine: dict[str, Any] = Field(default_factory=dict)

"""Finished models, their files and their cameras."""

from typing import Any

from pydantic import ConfigDict, Field

from splatmill.schema.base import Measured, Response, Time
from splatmill.schema.cameras import CameraSpec
from splatmill.schema.events import CurveRow


class ModelFile(Response):
    """One file of a model: model.ply, report.json, report.png, report.html, cameras.json, preview.jpg, progress.mp4."""

    name: str
    size: int = Field(ge=0, description="Bytes.")
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    media_type: str = "application/octet-stream"


class Model(Response):
    """A trained scene; its id is that of the job that made it."""

    id: str
    job: str
    name: str | None = None
    created_at: Time
    gaussians: int = Field(ge=0)
    bytes: int = Field(ge=0, description="Size of model.ply.")
    sh_degree: int = Field(ge=0, le=3)
    psnr: Measured = Field(default=None, description="dB, mean over the held-out views.")
    ssim: Measured = None
    files: list[ModelFile] = Field(default_factory=list)
    links: dict[str, str] = Field(default_factory=dict)


class ModelPage(Response):
    """Models, newest first."""

    models: list[Model]
    cursor: str | None = None


class ModelCamera(Response):
    """A camera of the capture, in the model's world, at the size it was trained with."""

    name: str = Field(description="The photo's name.")
    split: str = Field(default="train", description="train or test (held out).")
    camera: CameraSpec
    psnr: Measured = None


class ModelCameras(Response):
    """What `/v1/models/{id}/cameras` answers (and cameras.json holds)."""

    cameras: list[ModelCamera]


class StageSeconds(Response):
    """Seconds of each stage; the training clock stops during evaluation."""

    model_config = ConfigDict(extra="allow")

    sfm: float = 0.0
    train: float = 0.0
    evaluate: float = 0.0


class Report(Response):
    """report.json: error against run time, and what led to it."""

    model_config = ConfigDict(extra="allow")

    curve: list[CurveRow]
    seconds: StageSeconds
    plan: dict[str, Any] = Field(default_factory=dict)
    left_out: list[Any] = Field(default_factory=list, description="What was not done or not used, and why.")
    versions: dict[str, Any] = Field(default_factory=dict)
    machine: dict[str, Any] = Field(default_factory=dict)

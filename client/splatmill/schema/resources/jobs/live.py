"""What can be seen of a job while it runs: where photos were taken, and the scene in training."""

from typing import Literal

from pydantic import Field

from splatmill.schema.base import Response
from splatmill.schema.cameras import CameraSpec

SNAPSHOT_MEDIA_TYPE = "application/octet-stream"


class PlacedCamera(Response):
    """A photo whose camera is known."""

    name: str = Field(description="The photo's name.")
    split: Literal["train", "test"] | None = Field(
        default=None, description="train, or test for a held-out photo; null while that is not decided."
    )
    camera: CameraSpec


class UnusedPhoto(Response):
    """A photo or another file that is not used."""

    name: str
    why: str = Field(description="The reason, a clause.")


class Placement(Response):
    """The response of `/v1/jobs/{id}/cameras`: cameras and points as structure from motion places them.

    Once it is final, its coordinates are those of the snapshots and of the model. Before, each answer may have
    coordinates of its own.
    """

    final: bool = Field(description="Whether training uses these cameras; false while more may be placed.")
    cameras: list[PlacedCamera]
    points: list[tuple[float, float, float]] = Field(
        description="Positions of the scene's points, or of an even choice of them."
    )
    colors: list[tuple[int, int, int]] = Field(
        description="RGB of these points, 0 to 255; empty while the points have no colour."
    )
    points_total: int = Field(ge=0, description="Number of points of the whole scene.")
    unused: list[UnusedPhoto] = Field(
        default_factory=list, description="The photos that are not used; empty until it is final."
    )
    up: tuple[float, float, float] | None = Field(
        default=None, description="What is up, as in the cameras of the model; null until it is final."
    )


class Watch(Response):
    """The response to a request to watch a job."""

    seconds: float = Field(
        description="For how long the job makes snapshots; ask again before, for as long as somebody looks. 0 for a "
        "job that has ended."
    )

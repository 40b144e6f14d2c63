"""Requests for videos, and camera paths: a few views in a row, and the smooth way of a camera through them."""

import math
from collections.abc import Sequence
from typing import Literal, Self

from pydantic import Field, model_validator

from splatmill.schema.base import Request, Response
from splatmill.schema.cameras import Matrix, check_rigid

MOST_KEYFRAMES = 100
"""Views of one path."""

Quaternion = tuple[float, float, float, float]
"""A rotation, w x y z."""


class Keyframe(Request):
    """A view that a path leads through."""

    camera_to_world: Matrix = Field(
        description="Camera-to-world matrix with OpenCV axes, 4x4, row-major: a rotation and a position."
    )
    fov_y_deg: float = Field(gt=1, lt=170, description="Vertical field of view in degrees.")

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        check_rigid(self.camera_to_world)
        return self


class CameraPath(Request):
    """A path through views, which takes the same time from each to the next.

    Positions and rotations follow Catmull-Rom splines (E. Catmull and R. Rom, 1974), those of rotations over
    quaternions that are then scaled to length 1. So the camera passes each view exactly, and neither stops nor jumps
    there.
    """

    keyframes: list[Keyframe] = Field(min_length=2, max_length=MOST_KEYFRAMES)
    closed: bool = Field(default=False, description="Whether the path leads back to the first view.")

    def at(self, share: float) -> Keyframe:
        """Return the view at a share of the path's time, from 0 to 1."""
        count = len(self.keyframes)
        spans = count if self.closed else count - 1
        place = min(max(share, 0.0), 1.0) * spans
        first = min(int(place), spans - 1)
        views = [self._keyframe(first + offset) for offset in (-1, 0, 1, 2)]
        weights = _catmull_rom(place - first)
        position = [_blend(weights, [view.camera_to_world[i][3] for view in views]) for i in range(3)]
        fov = _blend(weights, [math.log(math.tan(math.radians(view.fov_y_deg) / 2)) for view in views])
        turns: list[Quaternion] = []
        for view in views:
            turn = _quaternion(view.camera_to_world)
            same_side = not turns or sum(a * b for a, b in zip(turn, turns[-1], strict=True)) >= 0
            turns.append(turn if same_side else (-turn[0], -turn[1], -turn[2], -turn[3]))
        w, x, y, z = (_blend(weights, [turn[i] for turn in turns]) for i in range(4))
        matrix = _matrix((w, x, y, z), position)
        degrees = math.degrees(2 * math.atan(math.exp(fov)))
        return Keyframe(camera_to_world=matrix, fov_y_deg=min(max(degrees, 1.001), 169.999))

    def _keyframe(self, index: int) -> Keyframe:
        """Return a view by its number; before the first and after the last come these again, unless it is closed."""
        count = len(self.keyframes)
        return self.keyframes[index % count if self.closed else min(max(index, 0), count - 1)]


class TraceRequest(Request):
    """A request for views along a camera path."""

    path: CameraPath
    count: int = Field(
        ge=2, le=1000, description="Number of views, the first at the start and the last at the end."
    )


class Trace(Response):
    """Views along a camera path, at equal times."""

    views: list[Keyframe]


class OrbitRequest(Request):
    """A video (MP4) from a camera that circles the scene once, or follows a path."""

    seconds: float = Field(default=6.0, ge=0.5, le=60, description="Length of the video in seconds.")
    fps: int = Field(default=24, ge=1, le=60, description="Frames per second.")
    width: int = Field(
        default=640, ge=16, le=3840, multiple_of=2, description="Width in pixels; must be even."
    )
    height: int = Field(
        default=480, ge=16, le=2160, multiple_of=2, description="Height in pixels; must be even."
    )
    fov_y_deg: float | None = Field(
        default=None,
        gt=1,
        lt=170,
        description="Vertical field of view in degrees. Left out, that of the training cameras.",
    )
    background: Literal["black", "white"] = Field(default="black", description="Colour behind the model.")
    camera_path: CameraPath | None = Field(
        default=None,
        description="The views that the camera leads through, each with its own field of view. Left out, it circles "
        "the scene.",
    )

    @model_validator(mode="after")
    def _one_field_of_view(self) -> Self:
        if self.camera_path is not None and self.fov_y_deg is not None:
            raise ValueError(
                "The field of view is given twice: fov_y_deg belongs to a circle, and the views of camera_path "
                "have their own."
            )
        return self

    @property
    def frames(self) -> int:
        """The number of frames in the video."""
        return max(1, round(self.seconds * self.fps))


def _catmull_rom(t: float) -> tuple[float, float, float, float]:
    """Weights of the points before, at the start, at the end, and after a span, at a share `t` of it."""
    return (
        ((-t + 2) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((-3 * t + 4) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )


def _blend(weights: Sequence[float], values: Sequence[float]) -> float:
    return sum(weight * value for weight, value in zip(weights, values, strict=True))


def _quaternion(m: Matrix) -> Quaternion:
    """Return the rotation of a matrix, by the largest of its four components (S. W. Shepperd, 1978)."""
    trace = m[0][0] + m[1][1] + m[2][2]
    squares = (trace, m[0][0], m[1][1], m[2][2])
    largest = squares.index(max(squares))
    if largest == 0:
        s = 2 * math.sqrt(1 + trace)
        return (s / 4, (m[2][1] - m[1][2]) / s, (m[0][2] - m[2][0]) / s, (m[1][0] - m[0][1]) / s)
    i = largest - 1
    j, k = (i + 1) % 3, (i + 2) % 3
    s = 2 * math.sqrt(max(1 + m[i][i] - m[j][j] - m[k][k], 1e-12))
    parts = [0.0, 0.0, 0.0, 0.0]
    parts[0] = (m[k][j] - m[j][k]) / s
    parts[1 + i] = s / 4
    parts[1 + j] = (m[i][j] + m[j][i]) / s
    parts[1 + k] = (m[i][k] + m[k][i]) / s
    return (parts[0], parts[1], parts[2], parts[3])


def _matrix(turn: Sequence[float], position: Sequence[float]) -> Matrix:
    length = math.hypot(*turn) or 1.0
    w, x, y, z = (part / length for part in turn)
    a, b, c = position
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), a),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), b),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), c),
        (0.0, 0.0, 0.0, 1.0),
    )

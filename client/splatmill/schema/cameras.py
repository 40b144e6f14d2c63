"""Cameras and pictures: from where a model is rendered, and what is wanted back.

A camera is a 4x4 row-major camera-to-world matrix with OpenCV axes (x right, y down, z forward) or OpenGL
axes (x right, y up, z backward), and a pinhole in pixels whose centres lie at half-integers.
"""

import json
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from splatmill.schema.base import Request

MAX_RENDER_SIDE = 8192
MAX_RENDER_PIXELS = 2**25  # 33.5 million: one float32 RGBA picture of it is half a gigabyte
RIGID_TOLERANCE = 1e-3  # matrices travel as decimal text; four written digits must pass
DEPTH_SCALE_HEADER = "Splatmill-Depth-Scale"
"""Response header of a 16-bit depth picture: depth = value * scale; value 0 is where nothing was hit."""

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Side = Annotated[int, Field(ge=1, le=MAX_RENDER_SIDE, description="Pixels.")]
Color = Literal["black", "white", "transparent"]


class Convention(StrEnum):
    opencv = "opencv"
    opengl = "opengl"


class CameraSpec(Request):
    """A view: where the camera stands, its picture size, and its lens as pixels or as a vertical angle."""

    camera_to_world: Matrix = Field(description="4x4, row-major; rotation and position, no scale.")
    convention: Convention = Field(default=Convention.opencv, description="Which axes the camera has.")
    width: Side
    height: Side
    fx: float | None = Field(default=None, gt=0, le=1e7, description="Focal length in pixels.")
    fy: float | None = Field(default=None, gt=0, le=1e7, description="Focal length in pixels.")
    cx: float | None = Field(default=None, ge=-1e6, le=1e6, description="Principal point in pixels.")
    cy: float | None = Field(default=None, ge=-1e6, le=1e6, description="Principal point in pixels.")
    fov_y_deg: float | None = Field(
        default=None, gt=0, lt=180, description="Vertical field of view in degrees."
    )

    @model_validator(mode="after")
    def _renderable(self) -> Self:
        check_pixels(self.width, self.height)
        pixels = (self.fx, self.fy, self.cx, self.cy)
        if self.fov_y_deg is None and any(value is None for value in pixels):
            raise ValueError("The lens is missing: give fx, fy, cx and cy in pixels, or fov_y_deg alone.")
        if self.fov_y_deg is not None and any(value is not None for value in pixels):
            raise ValueError("The lens is given twice: give fx, fy, cx and cy in pixels, or fov_y_deg alone.")
        _check_rigid(self.camera_to_world)
        return self

    @classmethod
    def looking_at(
        cls,
        eye: Sequence[float],
        target: Sequence[float],
        *,
        width: int,
        height: int,
        fov_y_deg: float = 50.0,
        up: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> Self:
        """A camera at `eye` that looks at `target`, `up` pointing up in the picture (world units throughout).

        Raises ValueError when eye and target coincide, or when the view runs along `up`.
        """
        forward = _unit([b - a for a, b in zip(eye, target, strict=True)], "Eye and target are one point.")
        right = _unit(_cross(forward, up), "The view runs along the up direction; give another `up`.")
        down = _cross(forward, right)
        rows = [(right[i], down[i], forward[i], float(eye[i])) for i in range(3)]
        matrix: Matrix = (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))
        return cls(camera_to_world=matrix, width=width, height=height, fov_y_deg=fov_y_deg)

    @classmethod
    def between(cls, a: "CameraSpec", b: "CameraSpec") -> Self:
        """A view that no photo took: half-way between two cameras, with the lens and size of `a`.

        The axes are the mean of both, made rigid again. Raises ValueError for cameras that look away from each other.
        """
        m, n = a.opencv_to_world(), b.opencv_to_world()
        down, forward = ([m[i][j] + n[i][j] for i in range(3)] for j in (1, 2))
        if sum(x * x for x in forward) < 1.0 or sum(x * x for x in down) < 1.0:
            raise ValueError(
                "The two cameras look in directions too far apart; there is no view between them."
            )
        z = _unit(forward, "")
        x = _unit(_cross(down, z), "The two cameras are turned against each other about the view axis.")
        y = _cross(z, x)
        rows = [(x[i], y[i], z[i], (m[i][3] + n[i][3]) / 2) for i in range(3)]
        fx, fy, cx, cy = a.pinhole()
        matrix: Matrix = (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))
        return cls(camera_to_world=matrix, width=a.width, height=a.height, fx=fx, fy=fy, cx=cx, cy=cy)

    def opencv_to_world(self) -> Matrix:
        """The camera-to-world matrix with OpenCV axes, whichever convention it came in."""
        if self.convention is Convention.opencv:
            return self.camera_to_world
        flipped = [(r[0], -r[1], -r[2], r[3]) for r in self.camera_to_world[:3]]
        return (flipped[0], flipped[1], flipped[2], (0.0, 0.0, 0.0, 1.0))

    def viewmat(self) -> Matrix:
        """World-to-camera with OpenCV axes: the transposed rotation, and its inverse translation."""
        m = self.opencv_to_world()
        rows: list[Row] = []
        for axis in range(3):
            column = (m[0][axis], m[1][axis], m[2][axis])
            rows.append((*column, -sum(c * m[i][3] for i, c in enumerate(column))))
        return (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))

    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels, whichever way the lens was given."""
        if self.fov_y_deg is not None:
            focal = 0.5 * self.height / math.tan(math.radians(self.fov_y_deg) / 2)
            return focal, focal, self.width / 2, self.height / 2
        assert self.fx is not None
        assert self.fy is not None
        assert self.cx is not None
        assert self.cy is not None
        return self.fx, self.fy, self.cx, self.cy

    def scaled_to(self, width: int) -> Self:
        """The same view at another width in pixels; the height follows the proportions."""
        factor = width / self.width
        fields = self.model_dump() | {"width": width, "height": max(1, round(self.height * factor))}
        if self.fov_y_deg is None:
            fx, fy, cx, cy = self.pinhole()
            fields |= {"fx": fx * factor, "fy": fy * factor, "cx": cx * factor, "cy": cy * factor}
        return type(self).model_validate(fields)


class Output(StrEnum):
    color = "color"
    depth = "depth"
    alpha = "alpha"


class Format(StrEnum):
    """`png` is 8 bit for colour and alpha, 16 bit for depth; `npy` is float32."""

    png = "png"
    jpeg = "jpeg"
    webp = "webp"
    npy = "npy"

    @property
    def media_type(self) -> str:
        """The content type of the answer."""
        return "application/x-npy" if self is Format.npy else f"image/{self.value}"


class RenderRequest(Request):
    """A picture of a model from a camera."""

    camera: CameraSpec
    output: Output = Field(
        default=Output.color, description="Colour, depth along the view axis, or coverage."
    )
    format: Format = Field(
        default=Format.png, description="Depth: png (16 bit, scale in a header) or npy (float32)."
    )
    background: Color = Field(default="black", description="What shows where the model is not.")
    quality: int = Field(default=90, ge=1, le=100, description="Of jpeg and webp.")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.output is Output.depth and self.format not in (Format.png, Format.npy):
            raise ValueError(f"Depth cannot be a {self.format.value}; ask for png (16 bit) or npy (float32).")
        if self.output is Output.color and self.format is Format.jpeg and self.background == "transparent":
            raise ValueError("A jpeg cannot be transparent; ask for png or webp, or for a background.")
        return self

    def to_query(self) -> dict[str, str]:
        """The request as query parameters of the cacheable GET; defaults are left out."""
        flat = self.model_dump(mode="json", exclude={"camera"}, exclude_defaults=True)
        camera = self.camera.model_dump(mode="json", exclude_defaults=True)
        matrix = camera.pop("camera_to_world")
        query = {name: str(value) for name, value in (flat | camera).items()}
        return query | {"camera_to_world": ",".join(repr(float(x)) for row in matrix for x in row)}

    @classmethod
    def from_query(cls, query: Mapping[str, str]) -> Self:
        """The request of such a query; pydantic's ValidationError where it does not fit."""
        fields: dict[str, Any] = dict(query)
        camera = {name: fields.pop(name) for name in CameraSpec.model_fields if name in fields}
        if "camera_to_world" in camera:
            numbers = camera["camera_to_world"].split(",")
            camera["camera_to_world"] = [numbers[i : i + 4] for i in range(0, len(numbers), 4)]
        return cls.model_validate(fields | {"camera": camera})

    def canonical(self) -> bytes:
        """The same bytes for the same picture, for an ETag; ways of writing one camera are not told apart."""
        shown = self.model_dump(mode="json", exclude={"camera"})
        camera = {
            "viewmat": self.camera.viewmat(),
            "pinhole": self.camera.pinhole(),
            "size": (self.camera.width, self.camera.height),
        }
        return json.dumps(shown | camera, sort_keys=True, separators=(",", ":")).encode()


class OrbitRequest(Request):
    """A video (MP4) of a camera that circles the scene once."""

    seconds: float = Field(default=6.0, ge=0.5, le=60, description="Length of the video.")
    fps: int = Field(default=24, ge=1, le=60, description="Frames per second.")
    width: int = Field(
        default=640, ge=16, le=3840, multiple_of=2, description="Pixels; video needs even sides."
    )
    height: int = Field(
        default=480, ge=16, le=2160, multiple_of=2, description="Pixels; video needs even sides."
    )
    fov_y_deg: float | None = Field(
        default=None, gt=1, lt=170, description="Left out: that of the training cameras."
    )
    background: Literal["black", "white"] = "black"

    @property
    def frames(self) -> int:
        """How many pictures the video has."""
        return max(1, round(self.seconds * self.fps))


def check_pixels(width: int, height: int) -> None:
    """ValueError for a picture with more than MAX_RENDER_PIXELS pixels."""
    if width * height > MAX_RENDER_PIXELS:
        raise ValueError(
            f"{width} x {height} is {width * height} pixels; at most {MAX_RENDER_PIXELS} are rendered."
        )


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _unit(v: Sequence[float], otherwise: str) -> tuple[float, float, float]:
    length = math.hypot(*v)
    if not length > 1e-9:
        raise ValueError(otherwise)
    return (v[0] / length, v[1] / length, v[2] / length)


def _check_rigid(m: Matrix) -> None:
    if not all(math.isfinite(x) for row in m for x in row):
        raise ValueError("camera_to_world holds a number that is not finite.")
    if any(abs(x - y) > 1e-6 for x, y in zip(m[3], (0, 0, 0, 1), strict=True)):
        raise ValueError(f"The last row of camera_to_world is {list(m[3])}; it must be [0, 0, 0, 1].")
    if any(abs(m[i][3]) > 1e9 for i in range(3)):
        raise ValueError("The camera stands further than 1e9 from the origin.")
    columns = [(m[0][j], m[1][j], m[2][j]) for j in range(3)]
    lengths = [math.hypot(*column) for column in columns]
    if any(abs(length - 1) > RIGID_TOLERANCE for length in lengths):
        shown = ", ".join(f"{length:.4g}" for length in lengths)
        if min(lengths) < 1e-9:
            raise ValueError("camera_to_world is singular: a column of its rotation is zero.")
        raise ValueError(f"camera_to_world is not rigid: its axes have lengths {shown} instead of 1.")
    det = sum(a * b for a, b in zip(columns[0], _cross(columns[1], columns[2]), strict=True))
    if abs(det) < RIGID_TOLERANCE:
        raise ValueError("camera_to_world is singular: its axes lie in one plane.")
    for i, j in ((0, 1), (0, 2), (1, 2)):
        dot = sum(a * b for a, b in zip(columns[i], columns[j], strict=True))
        if abs(dot) > 2 * RIGID_TOLERANCE:
            raise ValueError(f"camera_to_world is not rigid: its axes {i} and {j} are not at right angles.")
    if det < 0:
        raise ValueError("camera_to_world is a mirror: its determinant is -1; check its axes.")

"""Requests for rendered images, and the cameras they are rendered from.

A camera has a pose, a 4x4 row-major camera-to-world matrix with OpenCV axes (x right, y down, z forward) or OpenGL
axes (x right, y up, z backward), and a pinhole projection in pixels. Pixel centres lie at half-integers.
"""

import json
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from splatmill.schema.base import Request

MAX_RENDER_SIDE = 8192
MAX_RENDER_PIXELS = 2**25  # 33.5 million; one float32 RGBA image of this size takes 0.5 GB
RIGID_TOLERANCE = 1e-3  # matrices arrive as decimal text, and four digits must be enough
DEPTH_SCALE_HEADER = "Splatmill-Depth-Scale"
"""Response header of a 16-bit depth image: depth = pixel value * scale. The value 0 marks pixels without depth."""

MatrixRow = tuple[float, float, float, float]
Matrix = tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
Side = Annotated[int, Field(ge=1, le=MAX_RENDER_SIDE, description="In pixels.")]
Color = Literal["black", "white", "transparent"]


class Convention(StrEnum):
    opencv = "opencv"
    opengl = "opengl"


class CameraSpec(Request):
    """A camera: its pose, its image size, and its intrinsics in pixels or as a vertical field of view."""

    camera_to_world: Matrix = Field(
        description="Camera-to-world matrix, 4x4, row-major: a rotation and a position, without scale."
    )
    convention: Convention = Field(
        default=Convention.opencv,
        description=(
            "Axes of the camera: opencv (x right, y down, z forward) or opengl (x right, y up, z backward)."
        ),
    )
    width: Side
    height: Side
    fx: float | None = Field(default=None, gt=0, le=1e7, description="Horizontal focal length in pixels.")
    fy: float | None = Field(default=None, gt=0, le=1e7, description="Vertical focal length in pixels.")
    cx: float | None = Field(default=None, ge=-1e6, le=1e6, description="x of the principal point in pixels.")
    cy: float | None = Field(default=None, ge=-1e6, le=1e6, description="y of the principal point in pixels.")
    fov_y_deg: float | None = Field(
        default=None,
        gt=0,
        lt=180,
        description="Vertical field of view in degrees, in place of fx, fy, cx and cy.",
    )

    @model_validator(mode="after")
    def _renderable(self) -> Self:
        check_pixels(self.width, self.height)
        pixels = (self.fx, self.fy, self.cx, self.cy)
        if self.fov_y_deg is None and any(value is None for value in pixels):
            raise ValueError(
                "The camera's intrinsics are missing: give fx, fy, cx and cy in pixels, or fov_y_deg alone."
            )
        if self.fov_y_deg is not None and any(value is not None for value in pixels):
            raise ValueError(
                "The camera's intrinsics are given twice: give fx, fy, cx and cy in pixels, or "
                "fov_y_deg alone."
            )
        check_rigid(self.camera_to_world)
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
        """Return a camera at `eye` that points at `target`, with `up` pointing upwards in the image.

        `eye` and `target` are in world units, `fov_y_deg` is the vertical field of view in degrees. Raises ValueError
        when eye and target coincide, or when the viewing direction is parallel to `up`.
        """
        forward = _unit(
            [b - a for a, b in zip(eye, target, strict=True)], "Eye and target coincide; move one of them."
        )
        right = _unit(_cross(forward, up), "The viewing direction is parallel to `up`; give another `up`.")
        down = _cross(forward, right)
        rows = [(right[i], down[i], forward[i], float(eye[i])) for i in range(3)]
        matrix: Matrix = (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))
        return cls(camera_to_world=matrix, width=width, height=height, fov_y_deg=fov_y_deg)

    @classmethod
    def between(cls, a: "CameraSpec", b: "CameraSpec") -> Self:
        """Return a camera half-way between `a` and `b`, with the intrinsics and image size of `a`.

        Its axes are the mean of theirs, made orthonormal. Raises ValueError for cameras whose viewing directions or
        upward directions differ by too much.
        """
        m, n = a.opencv_to_world(), b.opencv_to_world()
        down, forward = ([m[i][j] + n[i][j] for i in range(3)] for j in (1, 2))
        if sum(x * x for x in forward) < 1.0 or sum(x * x for x in down) < 1.0:
            raise ValueError(
                "The two cameras look in directions too far apart; there is no view half-way between them."
            )
        z = _unit(forward, "")
        x = _unit(_cross(down, z), "The two cameras are rolled too far apart about the viewing axis.")
        y = _cross(z, x)
        rows = [(x[i], y[i], z[i], (m[i][3] + n[i][3]) / 2) for i in range(3)]
        fx, fy, cx, cy = a.pinhole()
        matrix: Matrix = (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))
        return cls(camera_to_world=matrix, width=a.width, height=a.height, fx=fx, fy=fy, cx=cx, cy=cy)

    def opencv_to_world(self) -> Matrix:
        """Return the camera-to-world matrix with OpenCV axes, whatever the convention of the request."""
        if self.convention is Convention.opencv:
            return self.camera_to_world
        flipped = [(r[0], -r[1], -r[2], r[3]) for r in self.camera_to_world[:3]]
        return (flipped[0], flipped[1], flipped[2], (0.0, 0.0, 0.0, 1.0))

    def viewmat(self) -> Matrix:
        """Return the world-to-camera matrix with OpenCV axes."""
        m = self.opencv_to_world()
        rows: list[MatrixRow] = []
        for axis in range(3):
            column = (m[0][axis], m[1][axis], m[2][axis])
            rows.append((*column, -sum(c * m[i][3] for i, c in enumerate(column))))
        return (rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0))

    def pinhole(self) -> tuple[float, float, float, float]:
        """Return fx, fy, cx and cy in pixels, also for a camera that was given a field of view."""
        if self.fov_y_deg is not None:
            focal = 0.5 * self.height / math.tan(math.radians(self.fov_y_deg) / 2)
            return focal, focal, self.width / 2, self.height / 2
        assert self.fx is not None
        assert self.fy is not None
        assert self.cx is not None
        assert self.cy is not None
        return self.fx, self.fy, self.cx, self.cy

    def scaled_to(self, width: int) -> Self:
        """Return the same view at another width in pixels; the aspect ratio stays."""
        factor = width / self.width
        fields = self.model_dump() | {"width": width, "height": max(1, round(self.height * factor))}
        if self.fov_y_deg is None:
            fx, fy, cx, cy = self.pinhole()
            fields |= {"fx": fx * factor, "fy": fy * factor, "cx": cx * factor, "cy": cy * factor}
        return type(self).model_validate(fields)


class Output(StrEnum):
    color = "color"
    depth = "depth"
    median_depth = "median_depth"
    normal = "normal"
    alpha = "alpha"


class Format(StrEnum):
    """The image format. `png` has 8 bits for colour and alpha and 16 for depth; `npy` holds float32."""

    png = "png"
    jpeg = "jpeg"
    webp = "webp"
    npy = "npy"

    @property
    def media_type(self) -> str:
        """The Content-Type of a response in this format."""
        return "application/x-npy" if self is Format.npy else f"image/{self.value}"


class RenderRequest(Request):
    """An image of a model from a camera."""

    camera: CameraSpec
    output: Output = Field(
        default=Output.color,
        description=(
            "What is rendered: color, depth (mean distance along the viewing axis, in units of the model), "
            "median_depth (that of the first surface, where half of the light is stopped), normal (of the surface, "
            "in the axes of the model) or alpha (opacity)."
        ),
    )
    format: Format = Field(
        default=Format.png,
        description=(
            "Format of the image. Depths are a png (16 bit; the header Splatmill-Depth-Scale holds the scale) "
            "or an npy (float32). In an image, a normal from -1 to 1 is a colour from 0 to 1, and black where "
            "there is none."
        ),
    )
    background: Color = Field(default="black", description="Colour behind the model.")
    quality: int = Field(default=90, ge=1, le=100, description="Quality of jpeg and webp.")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        depth = self.output in (Output.depth, Output.median_depth)
        if depth and self.format not in (Format.png, Format.npy):
            raise ValueError(f"Depth cannot be a {self.format.value}; ask for png (16 bit) or npy (float32).")
        if self.output is Output.color and self.format is Format.jpeg and self.background == "transparent":
            raise ValueError(
                "A jpeg cannot be transparent; ask for png or webp, or for the background black or white."
            )
        return self

    def to_query(self) -> dict[str, str]:
        """Return the query parameters of the GET request for the same image; defaults are left out."""
        flat = self.model_dump(mode="json", exclude={"camera"}, exclude_defaults=True)
        camera = self.camera.model_dump(mode="json", exclude_defaults=True)
        matrix = camera.pop("camera_to_world")
        query = {name: str(value) for name, value in (flat | camera).items()}
        return query | {"camera_to_world": ",".join(repr(float(x)) for row in matrix for x in row)}

    @classmethod
    def from_query(cls, query: Mapping[str, str]) -> Self:
        """Return the request of a query as `to_query` makes it. Raises pydantic.ValidationError for any other."""
        fields: dict[str, Any] = dict(query)
        camera = {name: fields.pop(name) for name in CameraSpec.model_fields if name in fields}
        if "camera_to_world" in camera:
            numbers = camera["camera_to_world"].split(",")
            camera["camera_to_world"] = [numbers[i : i + 4] for i in range(0, len(numbers), 4)]
        return cls.model_validate(fields | {"camera": camera})

    def canonical(self) -> bytes:
        """Return bytes for an ETag: equal for requests of the same image, however the camera is written."""
        shown = self.model_dump(mode="json", exclude={"camera"})
        camera = {
            "viewmat": self.camera.viewmat(),
            "pinhole": self.camera.pinhole(),
            "size": (self.camera.width, self.camera.height),
        }
        return json.dumps(shown | camera, sort_keys=True, separators=(",", ":")).encode()


def check_pixels(width: int, height: int) -> None:
    """Raise ValueError for an image of more than MAX_RENDER_PIXELS pixels."""
    if width * height > MAX_RENDER_PIXELS:
        raise ValueError(
            f"{width} x {height} is {width * height} pixels; at most {MAX_RENDER_PIXELS} can be rendered."
        )


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _unit(v: Sequence[float], otherwise: str) -> tuple[float, float, float]:
    length = math.hypot(*v)
    if not length > 1e-9:
        raise ValueError(otherwise)
    return (v[0] / length, v[1] / length, v[2] / length)


def check_rigid(m: Matrix) -> None:
    """Raise ValueError unless a camera-to-world matrix is a rotation and a position."""
    if not all(math.isfinite(x) for row in m for x in row):
        raise ValueError("camera_to_world holds a number that is not finite.")
    if any(abs(x - y) > 1e-6 for x, y in zip(m[3], (0, 0, 0, 1), strict=True)):
        raise ValueError(f"The last row of camera_to_world is {list(m[3])}; it must be [0, 0, 0, 1].")
    if any(abs(m[i][3]) > 1e9 for i in range(3)):
        raise ValueError("The camera is more than 1e9 units away from the origin.")
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
        raise ValueError(
            "camera_to_world holds a reflection: its determinant is -1; check the direction of its axes."
        )

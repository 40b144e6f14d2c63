"""What a file of another program says of the cameras of photos, before the photos are known."""

from __future__ import annotations

import codecs
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill.schema.quantities import format_bytes
from splatmill_worker.readers import reader_memory

MAX_FILE_BYTES = 512 * 2**20
"""Bytes of a file of cameras that is read: those of OpenSfM and Bundler hold the points too."""

MOST_SHOTS = 200_000
"""Photos of a file of cameras, at most."""

MAX_SHEAR = 1e-3
"""Largest element of R^T R - 1 of a rotation that counts as rounding."""

MAX_LENGTH_ERROR = 0.1
"""Error of the length of a quaternion that counts as rounding, as to one decimal."""

COPIES = 24
"""Times the size of a text that reading it takes, at most: JSON becomes lists of Python's numbers."""

Float = npt.NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0])
"""Turns the axes of a camera from those of OpenGL to those of OpenCV, and back."""

PINHOLE, BROWN, RATIONAL = "PINHOLE", "OPENCV", "FULL_OPENCV"
FISHEYE, FISHEYE_TANGENTIAL = "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"
"""COLMAP's names of the models that readers return. All begin with fx, fy, cx, cy."""


class NoCameras(ValueError):
    """A file has no cameras of the program that its name is usual for."""


@dataclass(frozen=True)
class Shot:
    """A photo with its camera.

    name: of the photo, as the file has it.
    pose: world-to-camera matrix with OpenCV axes, without its last row, by rows: 12 numbers.
    model: COLMAP's name of the camera model.
    focal: fx and fy.
    offset: the principal point less the middle of the photo.
    distortion: the other parameters of the model.
    size: width and height of the photo that these refer to; None: of the photo itself.
    relative: whether focal lengths and offsets are shares of the longest side of the photo, and not pixels.
    """

    name: str
    pose: tuple[float, ...]
    model: str
    focal: tuple[float, float]
    offset: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None
    relative: bool = False


@dataclass
class Shots:
    """The cameras of a file, or of the files of one program.

    left_out: names of photos without a usable camera, each with the reason.
    faulty: names of photos whose camera no photo can have, each with what is wrong.
    notes, warnings: sentences for the user.
    points, colors: of a sparse cloud, [N,3] and uint8 [N,3].
    """

    shots: list[Shot]
    left_out: list[tuple[str, str]] = field(default_factory=list)
    faulty: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    points: Float = field(default_factory=lambda: np.zeros((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))


def text_of(path: Path) -> str:
    """The text of a file in UTF-8, UTF-16 or UTF-32; bytes that are none of them become U+FFFD.

    Raises ValueError for a file that is too large.
    """
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ValueError(f"it has {format_bytes(size)}; at most {format_bytes(MAX_FILE_BYTES)} are read")
    reader_memory.check("reading it", COPIES * size, size)
    data = path.read_bytes()
    marks = {
        codecs.BOM_UTF32_LE: "utf-32",
        codecs.BOM_UTF32_BE: "utf-32",
        codecs.BOM_UTF16_LE: "utf-16",
        codecs.BOM_UTF16_BE: "utf-16",
    }
    encoding = next((name for mark, name in marks.items() if data.startswith(mark)), "utf-8-sig")
    return data.decode(encoding, "replace")


def numbers(text: str | None, count: int, what: str) -> list[float]:
    """`count` finite numbers of a text that separates them by blanks, commas or semicolons. Raises ValueError."""
    words = (text or "").replace(",", " ").replace(";", " ").split()
    if len(words) != count:
        raise ValueError(f"{what} has {len(words)} numbers, and {count} are needed")
    return [number(word, what) for word in words]


def number(text: object, what: str) -> float:
    """A finite number. Raises ValueError."""
    try:
        value = float(str(text))
    except ValueError:
        raise ValueError(f"{what} is {str(text)[:40]!r}, which is no number") from None
    if not math.isfinite(value):
        raise ValueError(f"{what} is {value}, which is not finite")
    return value


def pose_of(rotation: Float, center: Sequence[float] | Float) -> tuple[float, ...]:
    """The pose of a Shot with a world-to-camera rotation [3,3] at `center` [3]."""
    translation = -rotation @ np.asarray(center, np.float64)
    return tuple(np.hstack([rotation, translation[:, None]]).ravel().tolist())


def rotation_of(matrix: Float) -> Float:
    """The rotation [3,3] nearest to a matrix that is one up to rounding. Raises ValueError for any other."""
    determinant = float(np.linalg.det(matrix))
    if not (np.abs(matrix.T @ matrix - np.eye(3)).max() <= MAX_SHEAR and determinant > 0.0):
        raise ValueError(
            f"its rotation is none: the determinant is {determinant:.4g}, and that of a rotation is 1; the axes are "
            "mirrored, scaled or sheared"
        )
    u, _, v = np.linalg.svd(matrix)
    rotation: Float = u @ v
    return rotation


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> Float:
    """The rotation [3,3] of a quaternion whose length is 1, or was before it was rounded. Raises ValueError."""
    length = math.hypot(w, x, y, z)
    if not abs(length - 1.0) <= MAX_LENGTH_ERROR:
        raise ValueError(
            f"its quaternion ({w:.4g}, {x:.4g}, {y:.4g}, {z:.4g}) has the length {length:.4g}, and not 1"
        )
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pinhole_or(model: str, distortion: Iterable[float]) -> tuple[str, tuple[float, ...]]:
    """The model and its distortion; a pinhole's where there is none."""
    values = tuple(distortion)
    return (model, values) if any(values) else (PINHOLE, ())


def brown(
    radial: Sequence[float], along_x: float, along_y: float, reach: float
) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model, and its distortion, of a polynomial in the squared radius with up to four coefficients.

    along_x: tangential coefficient of r^2 + 2 x^2 in x, and of 2 x y in y. along_y: that of r^2 + 2 y^2 in y.
    reach: largest normalised radius of the photo. COLMAP has no fourth coefficient: a ratio of polynomials then stands
        for the polynomial within the photo.

    Raises ValueError where none is as close as MOST_DIFFERENT.
    """
    k1, k2, k3, k4 = [*radial, 0.0, 0.0, 0.0, 0.0][:4]
    # OpenCV's p1 is the coefficient of r^2 + 2 y^2 in y.
    tangential = (along_y, along_x)
    if not k3 and not k4:
        return pinhole_or(BROWN, (k1, k2, *tangential))
    if not k4:
        return RATIONAL, (k1, k2, *tangential, k3, 0.0, 0.0, 0.0)
    radii = np.linspace(0.0, reach, 400)
    factor = 1.0 + np.stack([radii ** (2 * order) for order in (1, 2, 3, 4)], axis=1) @ [k1, k2, k3, k4]
    coefficients = ratio(radii, factor)
    if coefficients is None:
        raise ValueError(
            f"its lens has a fourth radial coefficient, k4 = {k4:.4g}, which no camera model here has, and for which "
            "no other coefficients can stand; align again without k4, or export undistorted photos"
        )
    return RATIONAL, (*coefficients[:2], *tangential, *coefficients[2:])


MOST_DIFFERENT = 1e-5
"""Largest error, in focal lengths, with which a ratio of polynomials may stand for a polynomial: a hundredth of a pixel
at a focal length of a thousand."""


def ratio(radii: Float, factor: Float) -> tuple[float, ...] | None:
    """k1, k2, k3 above and k4, k5, k6 below the line, of the ratio of polynomials in the squared radius that stands for
    a factor at some radii in order; None where none is as close as MOST_DIFFERENT."""
    reach = radii[-1]
    powers = np.stack([radii ** (2 * order) for order in (1, 2, 3)], axis=1)
    scale = np.array([reach**2, reach**4, reach**6])
    columns = np.hstack([powers / scale, -factor[:, None] * powers / scale])
    solution = np.linalg.lstsq(columns, factor - 1.0, rcond=1e-14)[0]
    upper, lower = solution[:3] / scale, solution[3:] / scale
    below = 1.0 + powers @ lower
    if not (below > 0.1).all():
        return None
    error = np.abs(radii * ((1.0 + powers @ upper) / below - factor)).max()
    return (*upper.tolist(), *lower.tolist()) if error <= MOST_DIFFERENT else None

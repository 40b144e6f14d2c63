"""Cameras of RealityScan and RealityCapture: a CSV of internal and external parameters, or an XMP beside each photo.

Both give the focal length for a film 36 mm wide, and the principal point as its distance from the middle; both are
relative to the longest side of the photo. With x = X / Z and r^2 = x^2 + y^2, x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 +
k4 r^8) + t1 (r^2 + 2 x^2) + 2 t2 x y, y' = y (...) + t2 (r^2 + 2 y^2) + 2 t1 x y, as in Metashape.

An XMP has the rotation from world to camera, by rows and with OpenCV axes, and the position of the camera. A CSV has
angles in degrees: from camera, with OpenGL axes, to world, the rotation is Rz(-heading) Rx(pitch) Ry(roll).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splatmill_worker.readers.programs.shots import (
    MOST_SHOTS,
    Float,
    NoCameras,
    Shot,
    Shots,
    brown,
    number,
    numbers,
    pose_of,
    rotation_of,
    text_of,
)
from splatmill_worker.readers.programs.xml import root_of

FILM = 36.0
"""Millimetres of the longest side."""

REQUIRED = ("x", "y", "heading", "pitch", "roll", "f")
"""Columns of a CSV by which it is recognised, besides the name and `alt` or `z`."""

DISTORTION = ("k1", "k2", "k3", "k4", "t1", "t2")

MAX_SKEW, MAX_ASPECT = 1e-4, 0.5
"""Largest skew, of the longest side, that counts as none, and largest difference of a pixel's aspect ratio from 1."""

NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"

MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
"""Values of DistortionModel that are read; `division` is where it has no coefficients."""


def read_csv(paths: list[Path]) -> Shots:
    """The cameras of the table. Raises NoCameras for another table, and ValueError, which names the line."""
    text = text_of(paths[0])
    lines = [line for line in text.splitlines() if line.strip()]
    while lines and lines[0].lstrip().lower().startswith("#cameras"):
        del lines[0]
    heading = lines[0] if lines else ""
    separator = max(",;\t", key=heading.count)
    columns = [name.strip().lstrip("#").strip().lower() for name in heading.split(separator)]
    height = "alt" if "alt" in columns else "z"
    if not {*REQUIRED, height, "name"} <= set(columns):
        raise NoCameras("it is no table of internal and external parameters of RealityScan")
    cameras = Shots([])
    # With semicolons between values, a comma is that of a number.
    for row in csv.reader(io.StringIO("\n".join(lines[1:])), delimiter=separator):
        value = dict(zip(columns, row, strict=False))
        name = value.get("name", "").strip()
        if len(cameras.shots) >= MOST_SHOTS:
            raise ValueError(f"it has more than {MOST_SHOTS} cameras")
        if len(row) != len(columns) or not name:
            raise ValueError(
                f"the line of {name or 'a photo without a name'} has {len(row)} values, and the first line "
                f"{len(columns)} names: the file is cut off, or its decimals are written with commas"
            )
        try:
            cameras.shots.append(_of_row(name, value, height, decimal="," if separator == ";" else "."))
        except ValueError as error:
            cameras.faulty.append((name, str(error)))
    return cameras


def _of_row(name: str, value: dict[str, str], height: str, *, decimal: str) -> Shot:
    def at(key: str) -> float:
        text = value.get(key, "").strip()
        return number(text.replace(decimal, "."), key) if text else 0.0

    focal = at("f") / FILM
    if not focal > 0.0:
        raise ValueError(f"its focal length f is {at('f')}; it is that for a film of 36 mm, and positive")
    pose = pose_of(_of_angles(at("heading"), at("pitch"), at("roll")), [at("x"), at("y"), at(height)])
    offset = at("px"), at("py")
    model, distortion = _brown([at(key) for key in DISTORTION], focal, offset)
    return Shot(name, pose, model, (focal, focal), offset, distortion, None, relative=True)


def read_xmp(paths: list[Path]) -> Shots:
    """The cameras of all files with a pose; a photo has the name of its file. Raises NoCameras where none has one."""
    cameras = Shots([])
    without = 0
    for path in paths:
        try:
            shot = _of_xmp(path)
        except NoCameras:
            without += 1
            continue
        except ValueError as error:
            cameras.faulty.append((path.stem, f"in {path.name}, {error}"))
            continue
        cameras.shots.append(shot)
    if not cameras.shots and not cameras.faulty:
        raise NoCameras("none of the XMP files has a camera of RealityScan")
    if without:
        cameras.notes.append(f"XMP files without a camera of RealityScan: {without}.")
    return cameras


def _of_xmp(path: Path) -> Shot:
    try:
        root = root_of(path)
    except ValueError as error:
        raise error if NAMESPACE.strip("{}") in text_of(path) else NoCameras(str(error)) from error
    value: dict[str, str] = {}
    for element in root.iter():
        value |= {
            key.removeprefix(NAMESPACE): text for key, text in element.attrib.items() if NAMESPACE in key
        }
        if element.tag.startswith(NAMESPACE) and element.text:
            value[element.tag.removeprefix(NAMESPACE)] = element.text
    if "Rotation" not in value or "Position" not in value:
        raise NoCameras("it has no Rotation and Position")
    kind = value.get("DistortionModel", "perspective")
    coefficients = value.get("DistortionCoeficients") or "0 0 0 0 0 0"
    distortion = numbers(coefficients, 6, "DistortionCoeficients")
    if kind not in MODELS and not (kind == "division" and not any(distortion)):
        raise ValueError(
            f"the distortion model is {kind}, and those that are read are {', '.join(MODELS)}; choose one of them in "
            "the settings of the alignment, and export again"
        )
    if kind == "perspective":
        distortion = [0.0] * 6
    focal = number(value.get("FocalLength35mm"), "FocalLength35mm") / FILM
    aspect = number(value.get("AspectRatio", 1.0), "AspectRatio")
    skew = number(value.get("Skew", 0.0), "Skew")
    if not (focal > 0.0 and abs(aspect - 1.0) <= MAX_ASPECT):
        raise ValueError(
            f"FocalLength35mm is {focal * FILM:.4g} and AspectRatio {aspect:.4g}, as no camera has them"
        )
    if not abs(skew) <= MAX_SKEW:
        raise ValueError(f"the skew is {skew:.4g}, and no camera model here has one; align without it")
    offset = tuple(number(value.get(f"PrincipalPoint{axis}", 0.0), f"PrincipalPoint{axis}") for axis in "UV")
    rotation = rotation_of(np.reshape(numbers(value["Rotation"], 9, "Rotation"), (3, 3)))
    pose = pose_of(rotation, numbers(value["Position"], 3, "Position"))
    model, coefficients_ = _brown(distortion, focal, (offset[0], offset[1]))
    return Shot(
        path.stem,
        pose,
        model,
        (focal, aspect * focal),
        (offset[0], offset[1]),
        coefficients_,
        None,
        relative=True,
    )


def _brown(
    values: Sequence[float], focal: float, offset: tuple[float, float]
) -> tuple[str, tuple[float, ...]]:
    # No photo reaches further from its middle than half of its longest side times the root of two.
    reach = math.hypot(0.5 + abs(offset[0]), 0.5 + abs(offset[1])) / focal
    return brown(values[:4], values[4], values[5], reach)


def _of_angles(heading: float, pitch: float, roll: float) -> Float:
    """The world-to-camera rotation with OpenCV axes."""
    a, b, c = (math.radians(angle) for angle in (-heading, pitch, roll))
    z = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
    x = np.array([[1.0, 0.0, 0.0], [0.0, math.cos(b), -math.sin(b)], [0.0, math.sin(b), math.cos(b)]])
    y = np.array([[math.cos(c), 0.0, math.sin(c)], [0.0, 1.0, 0.0], [-math.sin(c), 0.0, math.cos(c)]])
    rotation: Float = (z @ x @ y @ np.diag([1.0, -1.0, -1.0])).T
    return rotation

"""Cameras and points of VisualSFM, as it, COLMAP, Theia and others write them: .nvm of the versions V3 and V3_R9T.

http://ccwu.me/vsfm/doc.html#nvm describes the file: after its version, the cameras and points of one model after
another, each with their number before them. A camera has the name of its photo, in which " stands for a blank, a focal
length, the quaternion w, x, y, z from world to camera, its place, one coefficient r and 0; in V3_R9T, matrix and
translation stand for quaternion and place. Axes are those of OpenCV. What the photo shows at m, from its middle and
over the focal length, a pinhole shows at m (1 + r |m|^2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.readers.programs.shots import (
    MOST_SHOTS,
    PINHOLE,
    RATIONAL,
    Float,
    NoCameras,
    Shot,
    Shots,
    numbers,
    pose_of,
    ratio,
    rotation_of,
    rotation_of_quaternion,
    text_of,
)

REACH = 0.9
"""Largest |m| up to which the lens is that of the file: the corner of a photo with 84 degrees across."""

PART = 0.7
"""Share of the |m| at which m (1 + r |m|^2) begins to fall, up to which the lens is that of the file."""


def read(paths: list[Path]) -> Shots:
    """The cameras of the model with the most. Raises NoCameras for another file, and ValueError for a damaged one."""
    lines = iter(text_of(paths[0]).splitlines())
    version, *calibration = next(lines, "").split() or [""]
    if version not in ("NVM_V3", "NVM_V3_R9T"):
        raise NoCameras("its first word is neither NVM_V3 nor NVM_V3_R9T")
    if calibration:
        raise ValueError(
            f"it has one calibration of all photos, {' '.join(calibration)[:80]!r}, which is not read; export the "
            "cameras as a COLMAP model, or as a file of Bundler"
        )
    models: list[Shots] = []
    while count := _count(lines, "cameras", models != []):
        model = Shots([])
        for index in range(count):
            _camera(model, _next(lines, f"camera {index} of {count}"), version == "NVM_V3_R9T")
        model.points, model.colors = _points(lines, _count(lines, "points", True))
        models.append(model)
    best = max(models, key=lambda model: len(model.shots))
    if len(models) > 1:
        best.warnings.append(
            f"Of {len(models)} models of VisualSFM, the one with the most photos is used, {len(best.shots)}."
        )
    return best


def _count(lines: Iterator[str], what: str, optional: bool) -> int:
    line = next((line for line in lines if line.strip()), None)
    if line is None and optional:
        return 0
    count = int(numbers(line, 1, f"the number of {what}")[0])
    if not 0 <= count <= (MOST_SHOTS if what == "cameras" else 2**31) or not (count or optional):
        raise ValueError(f"it announces {count} {what}")
    return count


def _next(lines: Iterator[str], what: str) -> str:
    line = next(lines, None)
    if line is None:
        raise ValueError(f"it ends before {what}: it is cut off")
    return line


def _camera(cameras: Shots, line: str, matrix: bool) -> None:
    count = 15 if matrix else 10
    words = line.rsplit(None, count)
    if len(words) != count + 1:
        raise ValueError(f"the line {line[:80]!r} has no name and {count} numbers: it is cut off")
    name = words[0].strip().replace('"', " ")
    values = numbers(" ".join(words[1:]), count, f"the camera of {name[:80]}")
    focal, r = values[0], values[-2]
    try:
        if not focal > 0.0:
            raise ValueError(f"its focal length is {focal}")
        if matrix:
            rotation = rotation_of(np.reshape(values[1:10], (3, 3)))
            pose = tuple(np.hstack([rotation, np.reshape(values[10:13], (3, 1))]).ravel().tolist())
        else:
            pose = pose_of(rotation_of_quaternion(*values[1:5]), values[5:8])
        model, distortion = _lens(r)
    except ValueError as error:
        cameras.faulty.append((name, str(error)))
        return
    cameras.shots.append(Shot(name, pose, model, (focal, focal), (0.0, 0.0), distortion))


def _lens(r: float) -> tuple[str, tuple[float, ...]]:
    if not r:
        return PINHOLE, ()
    places = np.linspace(0.0, REACH if r > 0.0 else min(REACH, PART / math.sqrt(-3.0 * r)), 400)
    factor = 1.0 + r * places**2
    coefficients = ratio(places * factor, 1.0 / factor)
    if coefficients is None:
        raise ValueError(f"its lens has r = {r:.4g}, which is too strong for the camera models that are read")
    return RATIONAL, (*coefficients[:2], 0.0, 0.0, *coefficients[2:])


def _points(lines: Iterator[str], count: int) -> tuple[Float, npt.NDArray[np.uint8]]:
    """Positions and colours; the places in photos that follow them are left out."""
    rows = []
    for index in range(count):
        what = f"point {index} of {count}"
        words = _next(lines, what).split()
        rows.append(numbers(" ".join(words[:6]), 6, what))
        if len(words) != 7 + 4 * int(numbers(" ".join(words[6:7]), 1, what)[0]):
            raise ValueError(
                f"{what} has another number of places in photos than it announces: it is cut off"
            )
    table = np.array(rows).reshape(-1, 6)
    return table[:, :3], np.clip(table[:, 3:], 0, 255).astype(np.uint8)

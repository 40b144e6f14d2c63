"""Cameras of the 3D Gaussian Splatting of Inria and of trainers like it: the cameras.json beside a trained model.

The file is a list. An entry has the name of its photo without folders and mostly without its suffix (img_name), the
size of the photo (width, height), fx and fy in pixels, the place of the camera (position) and its rotation by rows from
camera to world (rotation), with the axes of OpenCV. The principal point is the middle, and photos are undistorted.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from splatmill_worker.readers.programs.shots import (
    MOST_SHOTS,
    PINHOLE,
    NoCameras,
    Shot,
    Shots,
    number,
    pose_of,
    rotation_of,
    text_of,
)


def read(paths: list[Path]) -> Shots:
    """The cameras of the file. Raises NoCameras for another file, and ValueError for a damaged one."""
    try:
        document = json.loads(text_of(paths[0]))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is damaged or cut off: {error}") from error
    if not isinstance(document, list) or not all(isinstance(each, dict) for each in document):
        raise NoCameras("it is no list of cameras")
    if len(document) > MOST_SHOTS:
        raise ValueError(f"it has more than {MOST_SHOTS} cameras")
    cameras = Shots([])
    for index, entry in enumerate(document):
        name = entry.get("img_name")
        if not isinstance(name, str):
            raise ValueError(f"camera {index} has no img_name, which names its photo")
        try:
            cameras.shots.append(_shot(name, entry))
        except ValueError as error:
            cameras.faulty.append((name, str(error)))
    return cameras


def _shot(name: str, entry: dict[str, Any]) -> Shot:
    width, height = (int(number(entry.get(key), key)) for key in ("width", "height"))
    if not (width > 0 and height > 0):
        raise ValueError(f"its photo has {width} x {height} pixels")
    fx, fy = (number(entry.get(key), key) for key in ("fx", "fy"))
    if not min(fx, fy) > 0.0:
        raise ValueError(f"its focal length is {min(fx, fy)}; it must be positive")
    rows = entry.get("rotation")
    if not isinstance(rows, list) or len(rows) != 3:
        raise ValueError("its rotation has other values than three rows")
    rotation = rotation_of(np.array([_three(row, "a row of its rotation") for row in rows]))
    pose = pose_of(rotation.T, _three(entry.get("position"), "its position"))
    return Shot(name, pose, PINHOLE, (fx, fy), (0.0, 0.0), (), (width, height))


def _three(value: Any, what: str) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{what} has other values than 3 numbers")
    return [number(each, what) for each in value]

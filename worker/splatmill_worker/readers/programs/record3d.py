"""Cameras of Record3D: the metadata.json of an export of photos, or the file metadata in an .r3d, which is a zip.

The file has a list poses, with x, y, z and w of a quaternion from camera to world and the place of the camera, in
metres and with the axes of OpenGL; the numbers K of the camera matrix by columns, or for each photo fx, fy, cx and cy
in perFrameIntrinsicCoeffs; and the size of the photos, w and h. Photos are called by their number, from 0.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from splatmill_worker.readers.programs.shots import (
    FLIP,
    MOST_SHOTS,
    PINHOLE,
    NoCameras,
    Shot,
    Shots,
    number,
    pose_of,
    rotation_of_quaternion,
    text_of,
)


def read(paths: list[Path]) -> Shots:
    """The cameras of the file. Raises NoCameras for another file, and ValueError for a damaged one."""
    try:
        document = json.loads(text_of(paths[0]))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is damaged or cut off: {error}") from error
    poses = document.get("poses") if isinstance(document, dict) else None
    if not isinstance(poses, list) or "K" not in document:
        raise NoCameras("it has no poses and K, as the metadata of Record3D have")
    if len(poses) > MOST_SHOTS:
        raise ValueError(f"it has more than {MOST_SHOTS} poses")
    width, height = (int(number(document.get(key), key)) for key in ("w", "h"))
    if not (width > 0 and height > 0):
        raise ValueError(f"its photos have {width} x {height} pixels")
    k = _numbers(document["K"], 9, "K")
    own = document.get("perFrameIntrinsicCoeffs") or []
    if not isinstance(own, list) or (own and len(own) != len(poses)):
        raise ValueError(
            f"it has {len(poses)} poses, and perFrameIntrinsicCoeffs for another number of photos"
        )
    cameras = Shots([])
    for index, pose in enumerate(poses):
        fx, fy, cx, cy = _numbers(own[index], 4, f"the lens of {index}") if own else (k[0], k[4], k[6], k[7])
        if not min(fx, fy) > 0.0:
            raise ValueError(f"the focal length of {index} is {min(fx, fy)}; it must be positive")
        try:
            x, y, z, w, *place = _numbers(pose, 7, f"the pose of {index}")
            rotation = (rotation_of_quaternion(w, x, y, z) @ FLIP).T
        except ValueError as error:
            cameras.faulty.append((str(index), str(error)))
            continue
        offset = cx - 0.5 * width, cy - 0.5 * height
        pose = pose_of(rotation, place)
        cameras.shots.append(Shot(str(index), pose, PINHOLE, (fx, fy), offset, (), (width, height)))
    return cameras


def _numbers(value: Any, count: int, what: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{what} has other values than {count} numbers")
    return [number(each, what) for each in value]

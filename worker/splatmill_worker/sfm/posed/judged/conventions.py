"""Conventions of camera matrices that are confused with those of a file: which of them explains the matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Source
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.posed.judged.searched import epipolar_errors
from splatmill_worker.sfm.sift import Features

Float = npt.NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns axes of OpenGL (x right, y up, z backward) into those of OpenCV (x right, y down, z forward), and back."""

_OF_POSES: dict[str, Callable[[Float], npt.NDArray[Any]]] = {
    "from camera to world with OpenCV axes": lambda pose: np.linalg.inv(pose),
    "from world to camera with OpenGL axes": lambda pose: FLIP @ pose,
    "from camera to world with OpenGL axes": lambda pose: FLIP @ np.linalg.inv(pose),
}

CONVENTIONS: dict[str, dict[str, Callable[[Float], npt.NDArray[Any]]]] = {
    "transform_matrix is from camera to world, with OpenGL axes": {
        "from camera to world with OpenCV axes": lambda pose: FLIP @ pose,
        "from world to camera with OpenGL axes": lambda pose: FLIP @ np.linalg.inv(pose) @ FLIP,
        "from world to camera with OpenCV axes": lambda pose: np.linalg.inv(pose) @ FLIP,
    },
    "a COLMAP model has poses from world to camera, with OpenCV axes": _OF_POSES,
    "the file was read as its program writes it, and another program may have changed it": _OF_POSES,
}
"""By what a file has: what else its matrices may be, and the function from the matrix that was read to the
world-to-camera matrix that it then means."""

CLEARLY = 2.0
"""Factor by which another convention must explain more matches than that of the file."""


def of_source(source: Source) -> str:
    """What the files of a source have: a key of CONVENTIONS."""
    transforms, model, program = CONVENTIONS
    return {"colmap": model, "program": program}.get(source, transforms)


def better(
    source: Source,
    verified: Sequence[Pair],
    cameras: Sequence[Camera],
    features: Sequence[Features],
    database: pycolmap.Database,
    bound: float,
) -> tuple[str, float]:
    """The convention in which the cameras explain most of the matches, and the share of these; "" and 0 where that of
    the file is as good as any.

    bound: largest epipolar error of a match that is explained, pixels.
    """

    def share(changed: Callable[[Float], npt.NDArray[Any]]) -> float:
        read = [replace(camera, viewmat=changed(camera.viewmat)) for camera in cameras]
        errors = epipolar_errors(verified, read, features, database, in_front=True)
        return float((errors <= bound).mean()) if len(errors) else 0.0

    shares = {name: share(changed) for name, changed in CONVENTIONS[of_source(source)].items()}
    best = max(shares, key=lambda name: shares[name])
    if shares[best] < 0.5 or shares[best] < CLEARLY * share(lambda pose: pose):
        return "", 0.0
    return best, shares[best]

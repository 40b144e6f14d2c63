"""Cameras and points while COLMAP's incremental mapper places them, for a caller that shows them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.lens import without_distortion
from splatmill_worker.scene import Camera, Float
from splatmill_worker.sfm import features


@dataclass(frozen=True)
class Placed:
    """What a mapper has placed so far, in coordinates of its own.

    cameras: name of each registered photo, and its camera at the size of the reduced photo, without distortion.
    points: [n,3].
    """

    cameras: tuple[tuple[str, Camera], ...]
    points: Float


class PlacingObserver(Protocol):
    """Observes a mapping at moments of its own choice, while the mapper waits."""

    def is_due(self) -> bool:
        """Whether to look at the mapping now."""

    def observe(self, look: Callable[[], Placed]) -> None:
        """Look at the mapping: `look` copies it."""


def placed(model: pycolmap.Reconstruction, names: Sequence[str]) -> Placed:
    """The cameras and points of a model, which a mapper may be working on.

    names: of the photos, by their index.
    """
    cameras = []
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        viewmat = np.eye(4)
        viewmat[:3] = image.cam_from_world().matrix()
        camera = replace(without_distortion(model.cameras[image.camera_id]), viewmat=viewmat)
        cameras.append((names[features.photo_index(image.name)], camera))
    points = np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
    return Placed(tuple(sorted(cameras, key=lambda entry: entry[0])), points)

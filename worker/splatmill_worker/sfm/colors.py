"""Colours of the sparse points, read from the photos that observe them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.decoding.decoders import decode
from splatmill_worker.scene import View

SIDE = 320
"""Pixels of the longest side to which a photo is reduced at most: each pixel is then the mean of a small area."""


def color_points(
    model: pycolmap.Reconstruction,
    views: dict[int, View],
    pool: ThreadPoolExecutor,
    on_photo: Callable[[int], None],
) -> None:
    """Set the colour of each point to the mean over the photos that observe it, in place.

    views: by COLMAP's image id. on_photo: called with the number of photos that were read, after each.
    """
    sums: dict[int, npt.NDArray[np.float64]] = {}
    observed = pool.map(lambda item: _observed(model, *item), views.items())
    for done, (point_ids, colors) in enumerate(observed, 1):
        on_photo(done)
        for point_id, color in zip(point_ids, colors, strict=True):
            entry = sums.setdefault(point_id, np.zeros(4))  # red, green, blue, and the number of photos
            entry[:3] += color
            entry[3] += 1.0
    for point_id, entry in sums.items():
        model.points3D[point_id].color = np.round(entry[:3] / entry[3]).astype(np.uint8)


def _observed(
    model: pycolmap.Reconstruction, image_id: int, view: View
) -> tuple[list[int], npt.NDArray[np.uint8]]:
    """Ids of the points that a photo observes, and the photo's colours [n,3] there."""
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    observed = image.get_observation_points2D()
    if not observed:
        return [], np.zeros((0, 3), np.uint8)
    factor = min(1.0, SIDE / max(camera.width, camera.height))
    least = max(1, int(camera.width * factor)), max(1, int(camera.height * factor))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        photo = np.asarray(decode(view.image, at_least=least).convert("RGB"))
    height, width = photo.shape[:2]
    pixels = np.array([point.xy for point in observed]) * (width / camera.width, height / camera.height)
    x = np.clip(pixels[:, 0].astype(int), 0, width - 1)
    y = np.clip(pixels[:, 1].astype(int), 0, height - 1)
    return [point.point3D_id for point in observed], photo[y, x]

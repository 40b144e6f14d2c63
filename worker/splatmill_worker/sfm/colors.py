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
    ids = np.array(sorted(model.points3D.keys()), np.int64)
    sums = np.zeros((len(ids), 4))  # red, green, blue, and the number of photos
    observed = pool.map(lambda item: _observed(model, *item), views.items())
    for done, (point_ids, colors) in enumerate(observed, 1):
        on_photo(done)
        rows = np.searchsorted(ids, point_ids)
        np.add.at(sums, rows, np.column_stack([colors, np.ones(len(colors))]))
    shown = sums[:, 3] > 0.0
    means = np.round(sums[shown, :3] / sums[shown, 3:]).astype(np.uint8)
    for point_id, mean in zip(ids[shown].tolist(), means, strict=True):
        model.points3D[point_id].color = mean


def _observed(
    model: pycolmap.Reconstruction, image_id: int, view: View
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
    """Ids [n] of the points that a photo observes, and the photo's colours [n, 3] there."""
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    observed = image.get_observation_points2D()
    if not observed:
        return np.zeros(0, np.int64), np.zeros((0, 3), np.uint8)
    factor = min(1.0, SIDE / max(camera.width, camera.height))
    least = max(1, int(camera.width * factor)), max(1, int(camera.height * factor))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        photo = np.asarray(decode(view.image, at_least=least).convert("RGB"))
    height, width = photo.shape[:2]
    pixels = np.array([point.xy for point in observed]) * (width / camera.width, height / camera.height)
    x = np.clip(pixels[:, 0].astype(int), 0, width - 1)
    y = np.clip(pixels[:, 1].astype(int), 0, height - 1)
    return np.array([point.point3D_id for point in observed], np.int64), photo[y, x]

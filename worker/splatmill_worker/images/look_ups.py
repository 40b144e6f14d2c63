"""Where the pixels of undistorted photos lie on the photos: computed once for a lens, within a bound of memory."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.images import lens as lenses
from splatmill_worker.scene import Camera, Lens

KEPT_BYTES = 128 * 2**20
"""Size of the look-ups that are kept, at most, and of the last one however large it is: photos of one lens follow each
other. At 64 of them, photos with a lens each took several gigabytes."""

BAND = 2**18
"""Positions that are computed at a time: each takes a hundred bytes meanwhile, and 8 in the end."""

Key = tuple[Lens, tuple[float, float, float, float], int, int, int]
LookUp = tuple[torch.Tensor, torch.Tensor]

_kept: OrderedDict[Key, LookUp] = OrderedDict()
_lock = threading.Lock()


def of(
    lens: Lens, intrinsics: tuple[float, float, float, float], width: int, height: int, samples: int
) -> LookUp:
    """Where `samples` x `samples` positions in each pixel of a pinhole camera lie on the photo.

    intrinsics: fx, fy, cx, cy of the camera in pixels.

    Returns the positions [samples * height, samples * width, 2] in the range of grid_sample, -1 to 1, and the pixels
    [height, width] of which the photo covers every position.
    """
    key = lens, intrinsics, width, height, samples
    # Of several threads that load photos of one lens, one computes.
    with _lock:
        if key not in _kept:
            made = _computed(*key)
            while _kept and kept_bytes() + _size(made) > KEPT_BYTES:
                _kept.popitem(last=False)
            _kept[key] = made
        _kept.move_to_end(key)
        return _kept[key]


def forget() -> None:
    """Release all that are kept."""
    with _lock:
        _kept.clear()


def kept_bytes() -> int:
    """The size of those that are kept."""
    return sum(_size(each) for each in _kept.values())


def _size(look_up: LookUp) -> int:
    return sum(each.nbytes for each in look_up)


def _computed(
    lens: Lens, intrinsics: tuple[float, float, float, float], width: int, height: int, samples: int
) -> LookUp:
    camera = Camera(width, height, *intrinsics, np.eye(4))
    grid = np.empty((samples * height, samples * width, 2), np.float32)
    seen = np.empty((height, width), np.bool_)
    rows = max(1, BAND // (samples * samples * width))
    for top in range(0, height, rows):
        part = slice(top, min(top + rows, height))
        positions = _positions(lens, camera, part, samples)
        grid[samples * part.start : samples * part.stop] = positions
        inside = np.all(np.abs(positions) <= 1.0 + 1.0 / min(lens.width, lens.height), axis=2)
        seen[part] = inside.reshape(part.stop - part.start, samples, width, samples).all(axis=(1, 3))
    return torch.from_numpy(grid), torch.from_numpy(seen)


def _positions(lens: Lens, camera: Camera, rows: slice, samples: int) -> npt.NDArray[np.float64]:
    """The positions of some rows of pixels, in the range of grid_sample."""
    column = (np.arange(samples * camera.width) + 0.5) / samples
    row = (np.arange(samples * rows.start, samples * rows.stop) + 0.5) / samples
    x, y = camera.normalized(column, row)
    rays = np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1)
    pixels = lenses.distort(lens, rays.reshape(-1, 2)).reshape(rays.shape)
    return np.asarray(pixels / (lens.width, lens.height) * 2.0 - 1.0)

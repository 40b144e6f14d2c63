"""Undistorts photos. Where the pixels lie on the photos is computed once for a lens, within a bound of memory."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
import torch

from splatmill_worker.images import lens as lenses
from splatmill_worker.scene import Camera, Float, Lens

KEPT_BYTES = 128 * 2**20
"""Size of the look-ups that are kept, at most, and of the last one however large it is: photos of one lens follow each
other. At 64 of them, photos with a lens each took several gigabytes."""

BAND = 2**18
"""Positions that are computed at a time: each takes a hundred bytes meanwhile, and 8 in the end."""

Key = tuple[Lens, tuple[float, float, float, float], int, int, int, bytes]
LookUp = tuple[torch.Tensor, torch.Tensor]

_kept: OrderedDict[Key, LookUp] = OrderedDict()
_lock = threading.Lock()


def resampled(
    planes: torch.Tensor, lens: Lens, camera: Camera, samples: int, rotation: Float | None = None
) -> LookUp:
    """The planes [C,h,w] of a photo as [C,height,width] of a pinhole camera, of `samples` x `samples` look-ups in each
    pixel, and which pixels the photo covers [height,width].

    rotation: from the frame of the photo's camera to that of `camera`, [3,3]; None: they are the same.
    """
    grid, visible = of(lens, camera, samples, rotation)
    taken = torch.nn.functional.grid_sample(
        planes[None],
        grid[None],
        # With one look-up per pixel nothing is averaged afterwards, and bicubic interpolation blurs less.
        mode="bilinear" if samples > 1 else "bicubic",
        padding_mode="border",
        align_corners=False,
    )
    return torch.nn.functional.avg_pool2d(taken, samples)[0].clamp(0.0, 255.0), visible


def of(lens: Lens, camera: Camera, samples: int, rotation: Float | None = None) -> LookUp:
    """Where `samples` x `samples` positions in each pixel of a pinhole camera lie on the photo; see `resampled`.

    Returns the positions [samples * height, samples * width, 2] in the range of grid_sample, -1 to 1, and the pixels
    [height, width] of which the photo covers every position.
    """
    turn = np.eye(3) if rotation is None else rotation
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    key = lens, intrinsics, camera.width, camera.height, samples, turn.tobytes()
    # Of several threads that load photos of one lens, one computes.
    with _lock:
        if key not in _kept:
            made = _computed(lens, camera, samples, turn)
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


def _computed(lens: Lens, camera: Camera, samples: int, rotation: Float) -> LookUp:
    width, height = camera.width, camera.height
    grid = np.empty((samples * height, samples * width, 2), np.float32)
    visible = np.empty((height, width), np.bool_)
    rows = max(1, BAND // (samples * samples * width))
    for top in range(0, height, rows):
        part = slice(top, min(top + rows, height))
        positions = _positions(lens, camera, part, samples, rotation)
        grid[samples * part.start : samples * part.stop] = positions
        inside = np.all(np.abs(positions) <= 1.0 + 1.0 / min(lens.width, lens.height), axis=2)
        visible[part] = inside.reshape(part.stop - part.start, samples, width, samples).all(axis=(1, 3))
    return torch.from_numpy(grid), torch.from_numpy(visible)


def _positions(lens: Lens, camera: Camera, rows: slice, samples: int, rotation: Float) -> Float:
    """The positions of some rows of pixels, in the range of grid_sample."""
    column = (np.arange(samples * camera.width) + 0.5) / samples
    row = (np.arange(samples * rows.start, samples * rows.stop) + 0.5) / samples
    x, y = np.meshgrid(*camera.normalized(column, row), indexing="xy")
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ rotation
    pixels = lenses.distort(lens, rays).reshape(*x.shape, 2)
    return np.asarray(pixels / (lens.width, lens.height) * 2.0 - 1.0)

"""Photos as the coarse training has left them, in one file of which each tile reads its parts.

They are decoded, undistorted, reduced and brought to one light once, and not by every unit again.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.scene import Camera
from splatmill_worker.splat.views import Target, TrainingView

PIXELS, INDEX = ".bin", ".npz"
"""Suffixes of the pixels of all photos, one photo after the other, each as its RGB, its alpha and its mask; and of what
they are.
"""


def write_photos(path: Path, views: Sequence[TrainingView]) -> None:
    """Write the photos, at full size, and their cameras into files of this path without its suffix.

    Raises OSError, as where the disk is full.
    """
    targets = [view.full for view in views]
    with path.with_suffix(PIXELS).open("wb") as file:
        for target in targets:
            for plane in (target.rgb, target.alpha, target.mask):
                if plane is not None:
                    file.write(plane.contiguous().view(torch.uint8).numpy().data)
    cameras = [target.camera for target in targets]
    with path.with_suffix(INDEX).open("wb") as file:
        np.savez(
            file,
            names=np.array([view.name for view in views]),
            sizes=np.array([(camera.width, camera.height) for camera in cameras]),
            intrinsics=np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]),
            viewmats=np.array([camera.viewmat for camera in cameras]),
            planes=np.array([(target.alpha is not None, target.mask is not None) for target in targets]),
        )


def read_photos(path: Path) -> tuple[TrainingView, ...]:
    """The photos that `write_photos` left at `path`, whose pixels the system reads as they are used.

    Raises OSError, ValueError or KeyError for other files.
    """
    with np.load(path.with_suffix(INDEX), allow_pickle=False) as index:
        names, sizes, intrinsics, viewmats, planes = (
            index[key] for key in ("names", "sizes", "intrinsics", "viewmats", "planes")
        )
    if not len(names):
        return ()
    pixels = np.memmap(path.with_suffix(PIXELS), np.uint8, "r")
    total = int((sizes.prod(axis=1) * (3 + planes.sum(axis=1))).sum())
    if len(pixels) != total:
        raise ValueError(f"{path.with_suffix(PIXELS)} has {len(pixels)} bytes; its photos have {total}.")
    views, begin = [], 0

    def plane(*shape: int) -> Tensor:
        nonlocal begin
        begin += math.prod(shape)
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", "The given NumPy array is not writable"
            )  # nothing writes into photos
            return torch.from_numpy(pixels[begin - math.prod(shape) : begin].reshape(shape))

    for name, (width, height), (fx, fy, cx, cy), viewmat, (has_alpha, has_mask) in zip(
        names.tolist(), sizes.tolist(), intrinsics.tolist(), viewmats, planes.tolist(), strict=True
    ):
        rgb = plane(height, width, 3)
        alpha = plane(height, width) if has_alpha else None
        mask = plane(height, width).view(torch.bool) if has_mask else None
        camera = Camera(width, height, fx, fy, cx, cy, viewmat)
        views.append(TrainingView(name, {1: Target.of(camera, rgb, alpha, mask)}))
    return tuple(views)

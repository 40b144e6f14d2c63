"""Reads depth maps, and the maps of confidence beside them: in processes of their own, as all pictures of strangers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.no_photo import GREY_16

NUMBERS = ("I", "F")
"""Pillow's modes of a single channel of 32 bits, as integers and as floating-point numbers."""

LARGEST = 65535
"""The largest level of 16 bits: what lies farther has it too, and what was not measured."""

LEVELS = ("1", "L", "P")
"""Pillow's modes of a single channel of 8 bits or fewer."""


def distances(path: Path, name: str) -> npt.NDArray[np.float32]:
    """The levels of a depth map [h,w] as they are stored, and 0 for what is no distance: not finite, not above 0, or
    the largest of 16 bits.

    Raises UnusablePicture, about the file `name`, where it has no single channel of 16 or more bits, or holds no
    distance; and OSError.
    """
    with guarded.opened(path, name) as image, guarded.room(image):
        if image.mode not in (*GREY_16, *NUMBERS):
            what = (
                "8 bits per channel" if image.mode in (*LEVELS, "RGB", "RGBA", "LA") else f"mode {image.mode}"
            )
            raise UnusablePicture(
                "not_an_image",
                name,
                f"it has {what}, as a depth map has that is drawn to be looked at; distances are a single channel of "
                "16 bits, or of floating-point numbers in a TIFF",
            )
        stored = _pixels(image, name)
    levels = stored.astype(np.float32)
    if image.mode in GREY_16:
        levels[stored == LARGEST] = 0.0
    levels[~(np.isfinite(levels) & (levels > 0.0))] = 0.0
    if not levels.any():
        raise UnusablePicture(
            "not_an_image", name, "none of its pixels is a distance: all are 0, 65535 or not finite"
        )
    return levels


def confidences(path: Path, name: str) -> npt.NDArray[np.uint8]:
    """The levels of a map of confidence [h,w].

    Raises UnusablePicture, about the file `name`, where it has no single channel of 8 bits, and OSError.
    """
    with guarded.opened(path, name) as image, guarded.room(image):
        if image.mode not in LEVELS:
            raise UnusablePicture("not_an_image", name, "its confidence is no single channel of 8 bits")
        return _pixels(image, name).astype(np.uint8)


def _pixels(image: Image.Image, name: str) -> npt.NDArray[Any]:
    with guarded.damage(name):
        return np.array(image)

"""Masks of photos: whether they fit, and which levels they have. Their names: `splatmill.schema.files.masks`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from splatmill.schema.files.masks import MASK_FOLDERS, without_mask_folder
from splatmill.schema.files.photos import MASK_SUFFIXES
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.decode import decode, upright_size
from splatmill_worker.scene import MIN_SHOWN
from splatmill_worker.wording import plain

MAX_ASPECT_ERROR = 0.02
"""Relative difference of aspect ratios up to which a mask fits its photo."""

MAX_SCALE = 8
"""Sides of the photo that a side of its mask may have: photos are given reduced by up to eight, their masks not."""

MIN_SCALED_PIXELS = 50_000_000
"""Pixels up to which a mask of any scale is decoded."""


def mask_folder(directory: Path) -> Path | None:
    """The folder of masks in `directory`; None where there is none."""
    inside = [path for path in sorted(directory.iterdir()) if path.is_dir()]
    return next((path for name in MASK_FOLDERS for path in inside if path.name.lower() == name), None)


def masks_under(directory: Path) -> dict[str, Path]:
    """The masks in `directory`, by their name relative to it, without another folder of masks in it."""
    return {
        without_mask_folder(name := path.relative_to(directory).as_posix()) or name: path
        for path in sorted(directory.rglob("*"))
        if path.suffix.lower() in MASK_SUFFIXES and path.is_file()
    }


def shown_part(mask: Image.Image, shown_from: int = MIN_SHOWN) -> Image.Image:
    """The grey picture of what a decoded mask shows, from MIN_SHOWN on, and hides.

    A mask with transparent pixels hides these; any other hides dark ones, as in COLMAP.

    shown_from: its level from which it shows; unless that is MIN_SHOWN, the picture is black and white.
    """
    drawn = mask.mode == "RGBA" and np.asarray(mask)[:, :, 3].min() < 255
    grey = mask.getchannel("A") if drawn else mask.convert("L")
    return grey if shown_from == MIN_SHOWN else grey.point([0] * shown_from + [255] * (256 - shown_from))


def levels(mask: Path) -> list[int]:
    """The number of pixels of each level, 0 to 255, of a mask. Raises as `decode` does."""
    return shown_part(decode(mask)).histogram()


def unfit(faults: Sequence[tuple[str, str]]) -> list[str]:
    """A sentence for the user on photos whose mask is not used, each with what is wrong with the mask."""
    if not faults:
        return []
    (name, fault), count = faults[0], len(faults)
    if count == 1:
        return [f"The mask of {name} is not used: {fault}."]
    return [f"The masks of {count} photos are not used, such as that of {name}: {fault}."]


def mask_fault(mask: Path, photo: tuple[int, int], upright: bool = True) -> str | None:
    """What keeps a mask from being used, as a part of a sentence; None when it fits the photo. It is not decoded.

    photo: width and height in pixels.
    upright: whether these have the EXIF orientation applied, which is then applied to the mask too.

    Raises UnusablePicture when the mask has too many pixels: training without it would give another scene.
    """
    try:
        with guarded.opened(mask, name := f"{mask.parent.name}/{mask.name}") as image:
            width, height = upright_size(image) if upright else image.size
    except UnusablePicture as error:
        if error.code == "image_too_large":
            raise
        return f"it cannot be read ({error.reason})"
    except OSError as error:
        return f"it cannot be read ({plain(error)})"
    if not abs(width / height / (photo[0] / photo[1]) - 1.0) <= MAX_ASPECT_ERROR:
        return f"its shape differs from the photo's ({width} x {height} and {photo[0]} x {photo[1]} pixels)"
    if width > MAX_SCALE * photo[0] and width * height > MIN_SCALED_PIXELS:
        raise UnusablePicture(
            "image_too_large",
            name,
            f"it has {width} x {height} pixels, more than {MAX_SCALE} times as many a side as its photo "
            f"({photo[0]} x {photo[1]})",
        )
    return None

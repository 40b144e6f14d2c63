"""Masks of photos: whether they fit, and how much they hide. Their names: `splatmill.schema.masks`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from splatmill.schema.masks import MASK_FOLDERS, without_mask_folder
from splatmill.schema.photos import MASK_SUFFIXES
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.decode import Pixels, decode, upright_size

MAX_ASPECT_ERROR = 0.02
"""Relative difference of aspect ratios up to which a mask fits its photo."""

MAX_SCALE = 8
"""Sides of the photo that a side of its mask may have: photos are given reduced by up to eight, their masks not."""

MIN_SHOWN = 128
"""Grey level from which a pixel of a mask is shown."""

MAX_HIDDEN = 0.5
"""Share of the pixels of all photos that masks may hide without a warning."""

MAX_MEASURED = 64
"""Masks of which the hidden share is measured; each is decoded for it."""

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


def shown_part(mask: Image.Image) -> Image.Image:
    """The grey picture of what a decoded mask shows, 255, and hides, 0.

    A mask with transparent pixels hides these; any other hides dark ones, as in COLMAP.
    """
    drawn = mask.mode == "RGBA" and np.asarray(mask)[:, :, 3].min() < 255
    return mask.getchannel("A") if drawn else mask.convert("L")


def hidden_share(mask: Path) -> float:
    """The share of its pixels that a mask hides, 0 to 1. Raises as `decode` does."""
    shown: Pixels = np.asarray(shown_part(decode(mask)))
    return float((shown < MIN_SHOWN).mean())


def remarks(
    photos: int, masks: Sequence[Path], unused: Collection[str], share: Callable[[Path], float]
) -> tuple[list[str], list[str]]:
    """Sentences for the user, notes and warnings, on the masks of a capture with so many `photos`.

    masks: one of each photo that has one.
    unused: names of the masks that belong to no photo.
    share: as `hidden_share`; it is asked of MAX_MEASURED masks at most, evenly spaced.
    """
    notes, warnings = [], []
    if unused:
        named = ", ".join(sorted(unused)[:5]) + (", ..." if len(unused) > 5 else "")
        masks_are = "1 mask belongs" if len(unused) == 1 else f"{len(unused)} masks belong"
        warnings.append(f"{masks_are} to no photo by name, and no use is made of it: {named}.")
    shares = _measured(masks, share)
    if shares:
        hidden = sum(shares) / len(shares)
        notes.append(
            f"{len(masks)} of {photos} photos have a mask; the masks hide {hidden:.0%} of their pixels."
        )
        if hidden * len(masks) > MAX_HIDDEN * photos:
            warnings.append(
                f"The masks of {len(masks)} of {photos} photos hide {hidden:.0%} of their pixels. Black hides, and "
                "white is trained on: if the masks show in white what they should hide, invert them."
            )
    return notes, warnings


def unfit(faults: Sequence[tuple[str, str]]) -> list[str]:
    """A sentence for the user on photos whose mask is not used, each with what is wrong with the mask."""
    if not faults:
        return []
    (name, fault), count = faults[0], len(faults)
    if count == 1:
        return [f"The mask of {name} is not used: {fault}."]
    return [f"The masks of {count} photos are not used, such as that of {name}: {fault}."]


def _measured(masks: Sequence[Path], share: Callable[[Path], float]) -> list[float]:
    """What `share` returns of some of the masks, without those that do not decode: they end the loading of photos."""
    chosen = [
        masks[index] for index in np.linspace(0, len(masks) - 1, min(len(masks), MAX_MEASURED)).astype(int)
    ]

    def measured(mask: Path) -> float | None:
        try:
            return share(mask)
        except (UnusablePicture, OSError):
            return None

    with ThreadPoolExecutor() as pool:
        return [value for value in pool.map(measured, chosen) if value is not None]


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
        return f"it cannot be read ({error})"
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

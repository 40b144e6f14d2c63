"""Finds the masks of photos by their names, and checks that they fit."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from splatmill.schema.photos import MASK_SUFFIXES
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.decode import upright_size

MAX_ASPECT_ERROR = 0.02
"""Relative difference of aspect ratios up to which a mask fits its photo."""

MAX_SCALE = 8
"""Sides of the photo that a side of its mask may have: photos are given reduced by up to eight, their masks not."""

MIN_SCALED_PIXELS = 50_000_000
"""Pixels up to which a mask of any scale is decoded."""


def masks_under(directory: Path) -> dict[str, Path]:
    """The masks in `directory`, by their name relative to it."""
    return {
        path.relative_to(directory).as_posix(): path
        for path in sorted(directory.rglob("*"))
        if path.suffix.lower() in MASK_SUFFIXES and path.is_file()
    }


def mask_of(name: str, masks: dict[str, Path]) -> Path | None:
    """The mask of the photo `name`: by COLMAP's convention (name.jpg.png), the same name, or the same stem."""
    stem = str(PurePosixPath(name).with_suffix(""))
    candidates = (f"{name}.png", f"{stem}.png", name, *(f"{stem}{suffix}" for suffix in MASK_SUFFIXES))
    return next((masks[candidate] for candidate in candidates if candidate in masks), None)


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

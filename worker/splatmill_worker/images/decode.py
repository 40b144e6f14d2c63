"""One photo file to pixels: decoded, turned upright, reduced by whole factors on the way where the size allows."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pillow_heif
from PIL import Image, ImageOps

pillow_heif.register_heif_opener()

Pixels = npt.NDArray[np.uint8]
ORIENTATION = 0x0112
TURNED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
# Decompression bombs are refused by `check` on the header; Pillow's own limit would only add a warning.
Image.MAX_IMAGE_PIXELS = None


def upright_size(image: Image.Image) -> tuple[int, int]:
    """Width and height once the EXIF orientation is applied, from the header alone."""
    width, height = image.size
    return (height, width) if orientation(image) in TURNED else (width, height)


def orientation(image: Image.Image) -> int:
    """The EXIF orientation, 1 (as stored) where there is none or it makes no sense."""
    value = tags(image).get(ORIENTATION, 1)
    return value if value in range(1, 9) else 1


def tags(image: Image.Image) -> Image.Exif:
    """The EXIF that stands before the pixels; Pillow would decode a whole PNG to look for more behind them."""
    if image.format == "PNG" and not image.info.keys() & {"exif", "Raw profile type exif"}:
        return Image.Exif()
    return image.getexif()


def decode(path: Path, *, at_least: tuple[int, int] | None = None, upright: bool = True) -> Image.Image:
    """The photo as an RGB or RGBA image, or a grey one for a grey file.

    `at_least` (width, height): the smallest size the caller can use. The photo comes back reduced by a whole
    factor (box filter; for JPEG in the DCT, which saves most of the decoding time) as long as it stays that
    large. Only factors that divide both sides are used: a cut pixel at the border would shift the camera.

    Raises OSError or ValueError for files that do not decode.
    """
    with Image.open(path) as image:
        turn = upright and orientation(image) != 1
        want = at_least
        if want is not None and turn and orientation(image) in TURNED:
            want = want[1], want[0]
        if want is not None and image.format == "JPEG":
            factor = _factor(image.size, want, (8, 4, 2, 1))
            if factor > 1:
                image.draft(None, (image.width // factor, image.height // factor))
        image.load()
        photo = _plain_mode(ImageOps.exif_transpose(image) if turn else image)
        if (
            want is not None and photo.mode != "RGBA"
        ):  # which Pillow would average in 8-bit premultiplied steps
            factor = _factor(image.size, want, range(64, 0, -1))
            if factor > 1:
                photo = photo.reduce(factor)
        # `image` is closed on the way out; a photo that is still the same object keeps its pixels.
        return photo.copy() if photo is image else photo


def _factor(size: tuple[int, int], at_least: tuple[int, int], choices: Iterable[int]) -> int:
    """The first of `choices` that divides both sides of `size` and leaves `at_least`; 1 where none does."""
    for factor in choices:
        divides = size[0] % factor == 0 and size[1] % factor == 0
        if divides and size[0] // factor >= at_least[0] and size[1] // factor >= at_least[1]:
            return factor
    return 1


def _plain_mode(photo: Image.Image) -> Image.Image:
    """RGB, RGBA or L with 8 bits, whatever the file held."""
    if photo.mode in ("RGB", "RGBA", "L"):
        return photo
    if photo.mode.startswith(("I;16", "I", "F")):
        return Image.fromarray(_to_8_bits(np.asarray(photo)), "L")
    if photo.mode in ("LA", "PA", "La", "RGBa") or "transparency" in photo.info:
        return photo.convert("RGBA")
    return photo.convert("RGB")


def _to_8_bits(values: npt.NDArray[np.generic]) -> Pixels:
    """16-bit integers by their range, floats as 0..1 (the two conventions of TIFF files)."""
    if np.issubdtype(values.dtype, np.floating):
        return np.asarray(np.clip(np.nan_to_num(values) * 255.0 + 0.5, 0, 255), np.uint8)
    wide = values.astype(np.int64)
    return np.asarray(np.clip(wide >> 8 if wide.max(initial=0) > 255 else wide, 0, 255), np.uint8)

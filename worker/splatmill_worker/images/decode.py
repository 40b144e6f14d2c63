"""Decodes one photo: upright by its EXIF orientation, as sRGB of 8 bits per channel, and reduced by a whole factor."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageFile

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import guarded, transparency
from splatmill_worker.images.colors.photo_colors import PhotoColors

Pixels = npt.NDArray[np.uint8]
ORIENTATION = 0x0112
"""EXIF tag."""

UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What makes a photo of each EXIF orientation upright."""

TURNED = (5, 6, 7, 8)
"""EXIF orientations that swap width and height."""

MAX_REDUCTION = 64
"""Largest factor by which a decoded photo is reduced."""

OTHER_BYTE = {
    f"{mode};16{order}": f"{mode};16{'L' if order == 'B' else 'B'}"
    for mode in ("RGB", "RGBA")
    for order in "BLN"
}
"""Pillow's layouts of colours of 16 bits, of which it keeps the high byte (N: as this machine has it, which is L), and
those by which it keeps the low one instead."""

LARGEST_WHITE = 2.0
"""Largest of the floating-point numbers of a photo that count as going from 0 to 1: a little above is light beyond
white, which is cut off."""


def upright_size(image: Image.Image) -> tuple[int, int]:
    """Width and height in pixels once the EXIF orientation is applied; nothing is decoded."""
    width, height = image.size
    return (height, width) if orientation(image) in TURNED else (width, height)


def sizes(path: Path, name: str) -> tuple[tuple[int, int], tuple[int, int], int]:
    """Width and height of a picture in pixels, as stored and upright, and its orientation; nothing is decoded.

    Raises UnusablePicture, about the file `name`, and OSError.
    """
    with guarded.opened(path, name) as image:
        return image.size, upright_size(image), orientation(image)


def colors(path: Path, name: str) -> str:
    """How the colours of a picture become sRGB, as `PhotoColors.remark` says it; nothing is decoded.

    Raises UnusablePicture, about the file `name`, and OSError.
    """
    with guarded.opened(path, name) as image:
        return PhotoColors.of(image, tags(image), path).remark(image.mode)


def alpha(path: Path) -> transparency.Extent:
    """The smallest and the largest alpha of a photo, which is decoded to its end.

    Raises UnusablePicture and OSError.
    """
    with guarded.opened(path) as image:
        if image.format == "JPEG":
            image.draft(None, (1, 1))  # the smallest DCT scale, which still reads the whole file
        with guarded.room(image):
            photo = whole(image, path.name)
            check_numbers(image, path.name)
        return transparency.extent(photo)


def orientation(image: Image.Image) -> int:
    """The EXIF orientation, 1 to 8; 1 (as stored) when there is none or it is invalid."""
    value = tags(image).get(ORIENTATION, 1)
    return value if value in range(1, 9) else 1


def tags(image: Image.Image) -> Image.Exif:
    """The EXIF tags that precede the pixels, none where they are damaged.

    To find tags behind the pixels, Pillow would decode a whole PNG.
    """
    if image.format == "PNG" and not image.info.keys() & {"exif", "Raw profile type exif"}:
        return Image.Exif()
    try:
        return image.getexif()
    except guarded.DECODE_ERRORS:
        return Image.Exif()


def decode(path: Path, *, at_least: tuple[int, int] | None = None, upright: bool = True) -> Image.Image:
    """The photo as an sRGB image with or without alpha, or a grey one, with 8 bits per channel.

    at_least: width and height that the caller needs. The photo is reduced by the largest whole factor that leaves this
        size: JPEGs in the DCT, which saves most of the decoding time, others by a box filter. Only factors that divide
        both sides are used, because a cropped border would shift the principal point.
    upright: apply the EXIF orientation.

    Raises UnusablePicture when the file is no picture, exceeds a limit or does not decode, and FileNotFoundError.
    """
    with guarded.opened(path) as image:
        turn = UPRIGHT.get(orientation(image)) if upright else None
        stored = PhotoColors.of(image, tags(image), path)
        want = at_least
        if want is not None and turn is not None and orientation(image) in TURNED:
            want = want[1], want[0]
        if want is not None and image.format == "JPEG":
            factor = _factor(image.size, want, (8, 4, 2, 1))
            if factor > 1:
                image.draft(None, (image.width // factor, image.height // factor))
        with guarded.room(image):
            photo = whole(image, path.name)
            check_numbers(image, path.name)
            if turn is not None:
                photo = photo.transpose(turn)
            # Pillow would reduce RGBA in premultiplied steps of 8 bits, which loses colour.
            if want is not None and photo.mode != "RGBA":
                factor = _factor(image.size, want, range(MAX_REDUCTION, 0, -1))
                if factor > 1:
                    photo = photo.reduce(factor)
            photo = stored.srgb(photo, image.mode)
            # `image` is closed at the end of the block, so it must not be returned itself.
            return photo.copy() if photo is image else photo


def pixels(path: Path, at_least: tuple[int, int] | None, upright: bool) -> Pixels:
    """The photo that `decode` returns, as an array [H,W] or [H,W,C]. Raises as `decode` does."""
    return np.asarray(decode(path, at_least=at_least, upright=upright))


def picture_of(values: Pixels) -> Image.Image:
    """The photo of the array that `pixels` returns. Raises ValueError for another array."""
    modes = {(): "L", (3,): "RGB", (4,): "RGBA"}
    if not isinstance(values, np.ndarray) or values.dtype != np.uint8 or 0 in values.shape:
        raise ValueError("the pixels of a photo are bytes")
    mode = modes.get(values.shape[2:]) if values.ndim in (2, 3) else None
    if mode is None:
        raise ValueError("a photo has one, three or four channels")
    height, width = values.shape[:2]
    return Image.frombuffer(mode, (width, height), values.reshape(-1), "raw", mode, 0, 1)


def whole(image: Image.Image, name: str) -> Image.Image:
    """An opened picture decoded to its end, as RGB, RGBA or grey with 8 bits per channel, as stored. Colours of print
    become sRGB.

    Raises UnusablePicture, about the file `name`, when it does not decode.
    """
    with guarded.damage(name):
        low = _low_bytes(image)
        image.load()
        return _plain_mode(image) if low is None else _rounded(image, low)


def _low_bytes(image: Image.Image) -> Image.Image | None:
    """The low bytes of an opened file with colours of 16 bits, as a picture; None for others.

    Pillow has no colours of 16 bits, so the file is decoded once more.
    """
    if not isinstance(image, ImageFile.ImageFile):
        return None
    path, tiles = image.filename, image.tile
    layouts = {tile.args if isinstance(tile.args, str) else (tile.args or ("",))[0] for tile in tiles}
    if not path or len(layouts) != 1 or (layout := OTHER_BYTE.get(layouts.pop())) is None:
        return None
    with guarded.opened(Path(os.fsdecode(path))) as low:
        assert isinstance(low, ImageFile.ImageFile)
        low.tile = [
            tile._replace(args=layout if isinstance(tile.args, str) else (layout, *(tile.args or ())[1:]))
            for tile in low.tile
        ]
        low.load()
        return low.copy()


def _rounded(high: Image.Image, low: Image.Image) -> Image.Image:
    """The picture whose 16-bit values have these high and low bytes, with 8 bits, to the nearest level."""
    level = np.asarray(high)
    # A level of 8 bits is one of 257, so that its two bytes are equal.
    above = np.asarray(low).astype(np.int16) - level
    return Image.fromarray(
        level + (above > 128).astype(np.uint8) - (above < -128).astype(np.uint8), high.mode
    )


def check_numbers(image: Image.Image, name: str) -> None:
    """Raise UnusablePicture where the floating-point numbers of a decoded photo do not go from 0 to 1."""
    if image.mode != "F":
        return
    largest = float(np.nan_to_num(np.asarray(image)).max(initial=0.0))
    if largest > LARGEST_WHITE:
        raise UnusablePicture(
            "not_an_image",
            name,
            f"its floating-point numbers reach {largest:.4g}, and are read from 0 to 1; save it with 8 or 16 bits per "
            "channel, as sRGB",
        )


def _factor(size: tuple[int, int], at_least: tuple[int, int], choices: Iterable[int]) -> int:
    """The first of `choices` that divides both sides of `size` and leaves `at_least`; 1 when none does."""
    for factor in choices:
        divides = size[0] % factor == 0 and size[1] % factor == 0
        if divides and size[0] // factor >= at_least[0] and size[1] // factor >= at_least[1]:
            return factor
    return 1


def _plain_mode(photo: Image.Image) -> Image.Image:
    """The photo as RGB, RGBA or L with 8 bits per channel."""
    if photo.mode in ("CMYK", "LAB"):
        photo = PhotoColors(photo.info.get("icc_profile")).srgb(photo)
    if photo.mode in ("RGB", "RGBA", "L"):
        return photo
    if photo.mode.startswith(("I;16", "I", "F")):
        return Image.fromarray(_to_8_bits(np.asarray(photo)), "L")
    if photo.mode in ("LA", "PA", "La", "RGBa") or "transparency" in photo.info:
        return photo.convert("RGBA")
    return photo.convert("RGB")


def _to_8_bits(values: npt.NDArray[np.generic]) -> Pixels:
    """Grey values as uint8: floats from 0 to 1, integers from 0 to 255, or from 0 to 65535 when any exceeds 255."""
    if np.issubdtype(values.dtype, np.floating):
        return np.asarray(np.clip(np.nan_to_num(values) * 255.0 + 0.5, 0, 255), np.uint8)
    wide = values.astype(np.int64)
    # The whole of 16 bits is 257 times that of 8, to the nearest level.
    return np.asarray(np.clip((wide + 128) // 257 if wide.max(initial=0) > 255 else wide, 0, 255), np.uint8)

"""Looks whether a file is a photo that decodes, and what its header says of it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

from splatmill.schema.photos import MIN_PHOTO_SIDE
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import exif, guarded
from splatmill_worker.images.decode import tags, upright_size, whole
from splatmill_worker.images.photo_colors import PhotoColors

GIVE = "; give JPEG, PNG, WebP, TIFF, HEIC or AVIF photos, videos or zips"


@dataclass(frozen=True)
class Picture:
    """A picture that decodes.

    width, height: in pixels, with the EXIF orientation applied.
    exif: the tags that structure from motion uses.
    several: whether the file holds further pictures.
    colors: how its colours become sRGB, as `PhotoColors.remark` says it.
    """

    width: int
    height: int
    exif: exif.Exif
    several: bool
    colors: str


def examine(path: Path, name: str) -> Picture | str:
    """The picture, decoded once to its end, or the reason why the file cannot be used; errors call it `name`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of broken EXIF, with which a photo is usable
            with guarded.opened(path) as image:
                width, height = image.size
                if min(width, height) < MIN_PHOTO_SIDE:
                    return (
                        f"it has {width} x {height} pixels, which is too small: each side needs at least "
                        f"{MIN_PHOTO_SIDE}"
                    )
                width, height = upright_size(image)
                several = guarded.several(image)
                colors = PhotoColors.of(image, tags(image), path).remark(image.mode)
                found = exif.read(image)
                if image.format == "JPEG":
                    # This decodes at the smallest DCT scale, and still reads the whole file.
                    image.draft(None, (1, 1))
                with guarded.room(image):
                    whole(image, name)
    except UnusablePicture as error:
        return error.reason + (GIVE if error.code == "not_an_image" else "")
    except OSError as error:
        return f"it cannot be read: {error}"
    return Picture(width, height, found, several, colors)

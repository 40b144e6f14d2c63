"""Looks whether a file is a photo that decodes, and what its header says of it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image
from pydantic import PlainValidator

from splatmill.schema.files.photos import MIN_PHOTO_SIDE
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import exif, guarded, transparency
from splatmill_worker.images.colors.photo_colors import PhotoColors
from splatmill_worker.images.copies import SMALL_SIDE, small_grey
from splatmill_worker.images.decode import (
    UPRIGHT,
    Pixels,
    check_numbers,
    orientation,
    tags,
    upright_size,
    whole,
)
from splatmill_worker.images.no_photo import Kind, kind_of
from splatmill_worker.images.panoramas import panoramas
from splatmill_worker.wording import plain

GIVE = "; give JPEG, PNG, WebP, TIFF, HEIC or AVIF photos, videos or zips"


def _small(value: Any) -> Pixels:
    """The picture that a decoding process sends; raises ValueError for anything else."""
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.ndim != 2 or not value.size:
        raise ValueError("a small picture is grey values")
    if max(value.shape) > SMALL_SIDE:
        raise ValueError("a small picture is small")
    return value


@dataclass(frozen=True)
class Picture:
    """A picture that decodes.

    width, height: in pixels, with the EXIF orientation applied.
    exif: the tags that structure from motion uses.
    several: whether the file holds further pictures.
    colors: how its colours become sRGB, as `PhotoColors.remark` says it.
    sphere: what says that it is a panorama.
    alpha: its smallest and largest alpha.
    kind: what it seems to be, if no photo.
    small: the grey picture at low resolution, upright, of `copies.small_grey`.
    """

    width: int
    height: int
    exif: exif.Exif
    several: bool
    colors: str
    small: Annotated[Pixels, PlainValidator(_small)] = field(compare=False)
    sphere: panoramas.Sphere = ""
    alpha: transparency.Extent = (255, 255)
    kind: Kind = ""


def too_small(width: int, height: int) -> str | None:
    """Why a photo with so many pixels is not used; None for a larger one."""
    if min(width, height) >= MIN_PHOTO_SIDE:
        return None
    return f"it has {width} x {height} pixels, which is too small: each side needs at least {MIN_PHOTO_SIDE}"


def examine(path: Path, name: str) -> Picture | str:
    """The picture, decoded once to its end, or the reason why the file cannot be used; errors call it `name`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of broken EXIF, with which a photo is usable
            with guarded.opened(path) as image:
                width, height = image.size
                if (small := too_small(width, height)) is not None:
                    return small
                width, height = upright_size(image)
                several = guarded.several(image)
                colors = PhotoColors.of(image, tags(image), path).remark(image.mode)
                exif_tags, stated = exif.read(image), panoramas.stated(image)
                if stated not in ("", "stated"):
                    return stated
                turn = UPRIGHT.get(orientation(image))
                wide = panoramas.is_wide(width, height)
                if image.format == "JPEG":
                    # This decodes at the smallest DCT scale that suffices, and still reads the whole file.
                    image.draft(None, panoramas.SIZE if wide else (SMALL_SIDE, SMALL_SIDE))
                mode = image.mode
                with guarded.room(image):
                    photo = whole(image, name)
                    check_numbers(image, name)
                sphere: panoramas.Sphere = "stated" if stated else ""
                if wide and not stated:
                    sphere = panoramas.by_edges(photo if turn is None else photo.transpose(turn))
                alpha = transparency.extent(photo)
                kind = kind_of(mode, photo)
                grey = small_grey(photo)
                grey = grey if turn is None else np.asarray(Image.fromarray(grey).transpose(turn))
    except UnusablePicture as error:
        return error.reason + (GIVE if error.reason == guarded.UNKNOWN else "")
    except OSError as error:
        return f"it cannot be read: {plain(error)}"
    return Picture(width, height, exif_tags, several, colors, grey, sphere, alpha, kind)

"""Which photos are panoramas of 360 by 180 degrees: by their XMP, or else by their shape and edges.

A panorama twice as wide as high holds longitudes and latitudes. Its left border then continues its right one, and its
first and last row are half a pixel from the poles, so that hardly anything changes along them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image

from splatmill.schema.quantities import counted

Sphere = Literal["", "stated", "closed", "unclear"]
"""What says that a photo is a panorama: nothing, its XMP, its shape and edges, or these in part (its left border
continues the right one, and its first or last row is no pole)."""

SIZE = 512, 256
"""Pixels of the reduced photo whose edges are compared; a row is then 0.7 degrees high."""

SEAM = 2.0
"""Difference between the first and the last column, over the median of that between neighbouring columns, up to which
one continues the other (decisions: panorama-edges)."""

POLES = 0.35
"""Difference between neighbouring pixels of the first and of the last row, over that of the median row, up to which
they are poles (decisions: panorama-edges)."""

TEXTURED = 0.25
"""Spread of the first column over that of the photo from which it says something: plain backgrounds continue too."""

_FIELD = re.compile(rb"GPano:(\w{1,40})\s*(?:=\s*[\"']|>)\s*([\w.]{1,40})")

FILL = (
    "If it is a part of a panorama, fill it up to 360 by 180 degrees and mask what was filled; if it is an ordinary "
    "photo, remove its metadata (XMP)."
)
"""What to do about a photo whose XMP and shape disagree."""


def stated(image: Image.Image) -> Literal["", "stated"] | str:
    """What the XMP of an opened photo says (GPano, as cameras and phones write it): nothing, that it is a whole
    panorama, or else a reason why it cannot be used."""
    xmp = image.info.get("xmp")
    text = xmp if isinstance(xmp, bytes) else str(xmp or "").encode()
    fields = {name.decode(): value.decode() for name, value in _FIELD.findall(text)}
    projection = fields.get("ProjectionType")
    if projection is None:
        return ""
    if projection.lower() != "equirectangular":
        return (
            f"it is a panorama ({projection} by its metadata), which is not read: give equirectangular ones, or "
            "pinhole photos cut from it"
        )
    parts = [_share(fields, side) for side in ("Width", "Height")]
    size = f"{image.width} x {image.height} pixels"
    if min(parts) < 0.99:
        return (
            f"its metadata says that it is a part of a panorama, {parts[0]:.0%} of its width and {parts[1]:.0%} of its "
            f"height. {FILL}"
        )
    if not is_wide(image.width, image.height):
        return f"its metadata says that it is a panorama, which is twice as wide as high, and it has {size}. {FILL}"
    return "stated"


def _share(fields: dict[str, str], side: str) -> float:
    """The share of a panorama's width or height that its photo shows, by GPano; 1 where that is not given."""
    try:
        part, whole = (float(fields[f"{name}{side}Pixels"]) for name in ("CroppedAreaImage", "FullPano"))
        return part / whole if part > 0.0 and whole > 0.0 else 1.0
    except (KeyError, ValueError):
        return 1.0


def is_wide(width: int, height: int) -> bool:
    """Whether a photo is twice as wide as high, up to a pixel."""
    return abs(width - 2 * height) <= 2


def by_edges(photo: Image.Image) -> Sphere:
    """What the edges of a decoded photo say that is twice as wide as high."""
    small = (
        photo.convert("L") if photo.width < SIZE[0] else photo.resize(SIZE, Image.Resampling.BOX).convert("L")
    )
    grey = np.asarray(small, np.float64)
    across = np.abs(np.diff(grey, axis=1))
    seam = float(np.abs(grey[:, 0] - grey[:, -1]).mean())
    if not (
        grey[:, 0].std() >= TEXTURED * grey.std() > 0.0 and seam <= SEAM * np.median(across.mean(axis=0))
    ):
        return ""
    rows = across.mean(axis=1)
    return "closed" if max(rows[0], rows[-1]) <= POLES * np.median(rows) else "unclear"


@dataclass(frozen=True)
class Candidate:
    """A photo that may be a panorama.

    name, width, height: of the photo.
    source: the video or folder that it is from.
    is_frame: whether that is a video.
    sphere: what says so.
    """

    name: str
    width: int
    height: int
    source: str
    is_frame: bool
    sphere: Sphere


def decided(photos: Sequence[Candidate]) -> tuple[list[bool], list[str]]:
    """Whether each photo is a panorama, and sentences for the user on what was assumed.

    What the edges do not say is decided by the photos of the same size and folder, of which at least half are
    panoramas or are not; and so are all frames of a video.
    """
    keys = [(each.source, each.width, each.height) for each in photos]
    counts = Counter(keys)
    certain = Counter(
        key for key, each in zip(keys, photos, strict=True) if each.sphere in ("stated", "closed")
    )
    chosen, assumed, doubtful = [], [], []
    for key, each in zip(keys, photos, strict=True):
        most = 2 * certain[key] >= counts[key] and certain[key] > 0
        follows = each.sphere in ("unclear", "") or (each.is_frame and each.sphere != "stated")
        is_panorama = most if follows else each.sphere in ("stated", "closed")
        chosen.append(is_panorama)
        if is_panorama and each.sphere != "stated":
            assumed.append(each.name)
        if not is_panorama and each.sphere in ("closed", "unclear"):
            doubtful.append(each.name)
    said = []
    if assumed:
        are = counted(len(assumed), "photo is", "photos are")
        said.append(
            f"{are} taken for 360-degree panoramas, such as {assumed[0]}: twice as wide as high, with left and right "
            "edges that meet, and one colour all along the top and the bottom. If they are photos of an ordinary lens, "
            "crop a few columns of pixels from them."
        )
    if doubtful:
        are = counted(len(doubtful), "photo is", "photos are")
        said.append(
            f"{are} twice as wide as high with left and right edges that meet, as 360-degree panoramas are, such as "
            f"{doubtful[0]}, but with several colours along the top or the bottom, as these are not. They are taken "
            "for photos of an ordinary lens. If they are panoramas, write GPano:ProjectionType=equirectangular into "
            "their XMP, for example with exiftool."
        )
    return chosen, said

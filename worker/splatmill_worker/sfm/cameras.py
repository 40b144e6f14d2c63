"""Which photos were taken by the same camera, and where its focal length starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import Usable

# Without EXIF: COLMAP's guess, about a phone's main camera.
DEFAULT_FOCAL = 1.2  # of the longest side
# What lenses do, as focal length over the longest side: 8 mm fisheye to 300 mm on full frame.
FOCAL_BOUNDS = 0.2, 9.0


@dataclass(frozen=True)
class Group:
    """Photos (by index) that share one camera; `focal` over the longest side, `known` where EXIF gave it."""

    photos: tuple[int, ...]
    width: int
    height: int
    focal: float
    known: bool


def group(photos: Sequence[Usable]) -> list[Group]:
    """One camera for photos that agree in size, make, model, lens and focal length.

    Photos without EXIF share a camera where their sizes agree: a zoom in between costs less than a focal
    length that a single photo cannot determine.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, photo in enumerate(photos):
        tags = photo.exif
        key = (
            photo.width,
            photo.height,
            tags.make,
            tags.model,
            tags.lens,
            tags.focal_length,
            tags.focal_in_diagonals,
        )
        groups.setdefault(key, []).append(index)
    return [_group(tuple(members), photos[members[0]]) for members in groups.values()]


def _group(members: tuple[int, ...], photo: Usable) -> Group:
    focal = _focal(photo)
    known = focal is not None and FOCAL_BOUNDS[0] <= focal <= FOCAL_BOUNDS[1]
    return Group(
        members, photo.width, photo.height, focal if focal is not None and known else DEFAULT_FOCAL, known
    )


def _focal(photo: Usable) -> float | None:
    """The focal length over the longest side: from the 35 mm equivalent, else from COLMAP's table of sensors."""
    longest = max(photo.width, photo.height)
    if photo.exif.focal_in_diagonals is not None:
        return photo.exif.focal_in_diagonals * math.hypot(photo.width, photo.height) / longest
    if photo.exif.focal_length is None or photo.exif.model is None:
        return None
    bitmap = pycolmap.Bitmap.read(photo.path, as_rgb=False)
    focal = bitmap.exif_focal_length() if bitmap is not None else None
    return None if bitmap is None or focal is None else float(focal) / max(bitmap.width, bitmap.height)


def shares_one(groups: Sequence[Group]) -> bool:
    """Whether a single camera took all photos."""
    return len(groups) == 1

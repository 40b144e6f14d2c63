"""Photos grouped by the camera that took them, and each camera's initial focal length."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import UsablePhoto

DEFAULT_FOCAL = 1.2
"""Focal length over the longest side where EXIF gives none; COLMAP's default, about a phone's main camera."""

LEAST_OF_A_FOLDER = 3
"""Photos without EXIF from which a folder has a camera of its own; fewer hardly determine its focal length."""

FOCAL_BOUNDS = 0.2, 9.0
"""Focal lengths over the longest side that lenses have: from an 8 mm fisheye to 300 mm on full frame."""


@dataclass(frozen=True)
class CameraGroup:
    """Photos that share one camera.

    photos: their indices.
    width, height: their size in pixels.
    focal: initial focal length, over the longest side.
    known: whether EXIF gave the focal length.
    is_panorama: whether it shows 360 by 180 degrees, which has no focal length.
    """

    photos: tuple[int, ...]
    width: int
    height: int
    focal: float
    known: bool
    is_panorama: bool = False


def group(photos: Sequence[UsablePhoto]) -> list[CameraGroup]:
    """One camera for all photos that agree in size, make, model, lens and focal length.

    Photos without any of these tags also agree in their video or folder, since each may be of another camera; those of
    videos and folders with fewer than LEAST_OF_A_FOLDER share a camera. If the zoom changed among them, `lenses`
    divides them once they are placed; one camera per photo would be worse, because a single photo does not determine
    its lens.
    """
    keys = [_key(photo) for photo in photos]
    counts = Counter(keys)
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key if counts[key] >= LEAST_OF_A_FOLDER else key[:-1], []).append(index)
    return [_group(tuple(members), photos[members[0]]) for members in groups.values()]


def _key(photo: UsablePhoto) -> tuple[object, ...]:
    """What photos of one camera agree in; last, the video or folder of a photo without EXIF of its camera."""
    if photo.is_panorama:
        return photo.width, photo.height, "panorama"
    tags = photo.exif
    camera = (tags.make, tags.model, tags.lens, tags.focal_length, tags.focal_in_diagonals)
    source = photo.sequence or PurePosixPath(photo.name).parent if camera == (None,) * len(camera) else None
    return photo.width, photo.height, *camera, source


def _group(members: tuple[int, ...], photo: UsablePhoto) -> CameraGroup:
    if photo.is_panorama:
        return CameraGroup(members, photo.width, photo.height, 1.0 / (2.0 * math.pi), True, is_panorama=True)
    focal = _focal(photo)
    known = focal is not None and FOCAL_BOUNDS[0] <= focal <= FOCAL_BOUNDS[1]
    return CameraGroup(
        members, photo.width, photo.height, focal if focal is not None and known else DEFAULT_FOCAL, known
    )


def _focal(photo: UsablePhoto) -> float | None:
    """The focal length over the longest side, by EXIF; None when EXIF does not give it.

    It is computed from the 35 mm equivalent, or else from the focal length and COLMAP's table of sensor widths.
    """
    longest = max(photo.width, photo.height)
    if photo.exif.focal_in_diagonals is not None:
        return photo.exif.focal_in_diagonals * math.hypot(photo.width, photo.height) / longest
    if photo.exif.focal_length is None or photo.exif.model is None:
        return None
    bitmap = pycolmap.Bitmap.read(photo.path, as_rgb=False)
    focal = bitmap.exif_focal_length() if bitmap is not None else None
    return None if bitmap is None or focal is None else float(focal) / max(bitmap.width, bitmap.height)

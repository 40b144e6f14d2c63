"""Photos grouped by the camera that took them, and each camera's initial focal length."""

from __future__ import annotations

import math
import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from splatmill.schema.quantities import counted
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.exif import EXIF_IFD, FOCAL_LENGTH, MAKE, MODEL
from splatmill_worker.images.prepare import UsablePhoto

DEFAULT_FOCAL = 1.2
"""Focal length over the longest side where EXIF gives none; COLMAP's default, about a phone's main camera."""

LEAST_OF_A_FOLDER = 3
"""Photos without EXIF from which a folder has a camera of its own; fewer hardly determine its focal length."""

MIN_FISHEYE_FOCAL = 0.1
"""Least focal length of a fisheye over the longest side: a circle of 280 degrees that is as high as a photo of
2 by 1."""

HALF_FISHEYE = math.pi / 2.0
"""Angle in radians from the axis of a fisheye lens to the border of its circle, or without one to the corners."""

_FISHEYE = re.compile("fish.?eye", re.IGNORECASE)

FOCAL_BOUNDS = 0.2, 9.0
"""Focal lengths over the longest side that lenses have: from an 8 mm fisheye to 300 mm on full frame."""

LENSES = 0.1, 10_000.0
"""Focal lengths of lenses in millimetres; others in EXIF are mistakes."""


@dataclass(frozen=True)
class CameraGroup:
    """Photos that share one camera.

    photos: their indices.
    width, height: their size in pixels.
    focal: initial focal length, over the longest side.
    known: whether EXIF gave the focal length.
    is_panorama: whether it shows 360 by 180 degrees, which has no focal length.
    is_fisheye: whether its photos are of a fisheye lens; its focal length is then that of an equidistant one which sees
        180 degrees, and stands for the angle between two pixels.
    center: where its axis meets the photos, as shares of their width and height.
    """

    photos: tuple[int, ...]
    width: int
    height: int
    focal: float
    known: bool
    is_panorama: bool = False
    is_fisheye: bool = False
    center: tuple[float, float] = (0.5, 0.5)


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


def fisheye_note(groups: Sequence[CameraGroup]) -> list[str]:
    """A sentence for the user about the photos that are taken for those of a fisheye lens; none without them."""
    photos = sum(len(group.photos) for group in groups if group.is_fisheye)
    if not photos:
        return []
    return [
        f"{counted(photos, 'photo is', 'photos are')} taken for those of a fisheye lens, by a round picture in a dark "
        "frame or by the name of the lens in EXIF."
    ]


def as_pinholes(groups: Sequence[CameraGroup]) -> list[CameraGroup]:
    """The groups with an ordinary lens for each fisheye."""
    return [
        replace(group, focal=DEFAULT_FOCAL, known=False, is_fisheye=False, center=(0.5, 0.5))
        if group.is_fisheye
        else group
        for group in groups
    ]


def _key(photo: UsablePhoto) -> tuple[object, ...]:
    """What photos of one camera agree in; last, the video or folder of a photo without EXIF of its camera."""
    if photo.is_panorama:
        return photo.width, photo.height, "panorama"
    tags = photo.exif
    # A circle is that of all photos of its size in a folder.
    if photo.circle is not None:
        return photo.width, photo.height, photo.circle, "fisheye"
    camera = (tags.make, tags.model, tags.lens, tags.focal_length, tags.focal_in_diagonals)
    source = photo.sequence or PurePosixPath(photo.name).parent if camera == (None,) * len(camera) else None
    return photo.width, photo.height, *camera, source


def _group(members: tuple[int, ...], photo: UsablePhoto) -> CameraGroup:
    if photo.is_panorama:
        return CameraGroup(members, photo.width, photo.height, 1.0 / (2.0 * math.pi), True, is_panorama=True)
    if photo.circle is not None:
        circle = photo.circle
        return CameraGroup(
            members,
            photo.width,
            photo.height,
            circle.radius / HALF_FISHEYE,
            True,
            is_fisheye=True,
            center=(circle.x, circle.y),
        )
    if _FISHEYE.search(photo.exif.lens or ""):
        radius = math.hypot(photo.width, photo.height) / 2.0 / max(photo.width, photo.height)
        return CameraGroup(members, photo.width, photo.height, radius / HALF_FISHEYE, True, is_fisheye=True)
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
    return _focal_by_sensor(photo.exif.make or "", photo.exif.model, photo.exif.focal_length)


def _focal_by_sensor(make: str, model: str, millimetres: float) -> float | None:
    """The focal length over the longest side, where COLMAP knows the sensor of the camera."""
    if not LENSES[0] <= millimetres <= LENSES[1]:
        return None
    tags = Image.Exif()
    tags[MAKE], tags[MODEL] = make, model
    tags.get_ifd(EXIF_IFD)[FOCAL_LENGTH] = IFDRational(round(1000 * millimetres), 1000)
    # COLMAP reads the tags of a picture alone, and gets one of the worker's own, not the photo of a stranger.
    with tempfile.NamedTemporaryFile(suffix=".jpg") as file:
        Image.new("L", (16, 16)).save(file.name, exif=tags)
        bitmap = pycolmap.Bitmap.read(file.name, as_rgb=False)
    focal = bitmap.exif_focal_length() if bitmap is not None else None
    return None if bitmap is None or focal is None else float(focal) / max(bitmap.width, bitmap.height)

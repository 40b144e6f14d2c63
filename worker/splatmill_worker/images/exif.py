"""The EXIF tags that structure from motion uses: camera, focal length and GPS position."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from PIL import Image

from splatmill_worker.images.decode import tags
from splatmill_worker.images.guarded import DECODE_ERRORS

MAKE, MODEL, EXIF_IFD, GPS_IFD = 0x010F, 0x0110, 0x8769, 0x8825
FOCAL_LENGTH, FOCAL_LENGTH_35MM, LENS_MODEL = 0x920A, 0xA405, 0xA434
"""EXIF tags."""

MAX_TEXT = 200
"""Characters of a name that are read; EXIF allows megabytes."""

FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
"""Millimetres; the 35 mm equivalent focal length refers to this diagonal."""


@dataclass(frozen=True)
class Exif:
    """EXIF of one photo; None: absent or invalid.

    make, model, lens: of the camera.
    focal_length: in millimetres.
    focal_in_diagonals: focal length over the photo's diagonal, from the 35 mm equivalent.
    latitude, longitude: in degrees, positive to the north and east.
    altitude: in metres above sea level.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_length: float | None = None
    focal_in_diagonals: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None


def read(image: Image.Image) -> Exif:
    """The tags of an opened image; unreadable EXIF counts as absent."""
    entries = tags(image)
    try:
        details, gps = entries.get_ifd(EXIF_IFD), entries.get_ifd(GPS_IFD)
    except DECODE_ERRORS:
        return Exif()
    equivalent = _positive(details.get(FOCAL_LENGTH_35MM))
    latitude, longitude = (
        _degrees(gps.get(2), gps.get(1), "S", 90.0),
        _degrees(gps.get(4), gps.get(3), "W", 180.0),
    )
    # Devices without a GPS fix write exactly 0, 0.
    if latitude is None or longitude is None or (latitude == 0.0 and longitude == 0.0):
        latitude = longitude = None
    altitude = _number(gps.get(6))
    if altitude is not None and gps.get(5) in (1, b"\x01"):
        altitude = -altitude
    return Exif(
        make=_text(entries.get(MAKE)),
        model=_text(entries.get(MODEL)),
        lens=_text(details.get(LENS_MODEL)),
        focal_length=_positive(details.get(FOCAL_LENGTH)),
        focal_in_diagonals=None if equivalent is None else equivalent / FULL_FRAME_DIAGONAL,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
    )


def _text(value: Any) -> str | None:
    text = str(value)[:MAX_TEXT].strip("\x00 ") if value is not None else ""
    return text or None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0.0 else None


def _degrees(value: Any, side: Any, negative: str, bound: float) -> float | None:
    """Degrees, minutes and seconds as one signed number of degrees; None when they are invalid or exceed `bound`."""
    if not isinstance(value, tuple | list) or len(value) != 3:
        return None
    parts = [_number(part) for part in value]
    if any(part is None for part in parts):
        return None
    degrees = sum((part or 0.0) / 60.0**index for index, part in enumerate(parts))
    if not degrees <= bound:
        return None
    return -degrees if _text(side) == negative else degrees

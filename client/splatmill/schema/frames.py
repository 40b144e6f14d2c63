"""The coordinates of a model whose cameras were recovered from the photos, and a distance that fixes their unit."""

import math
import re
import shlex
from typing import Literal, NamedTuple

from pydantic import Field

from splatmill.schema.base import Response

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3, "in": 0.0254, "ft": 0.3048}
_LENGTH = re.compile(r"(\d+(?:\.\d+)?|\.\d+) ?([a-z]+)", re.ASCII)


class KnownDistance(NamedTuple):
    """The distance between the cameras of two photos.

    first, second: names of the photos.
    metres: how far apart they were taken.
    """

    first: str
    second: str
    metres: float


def known_distance(text: str) -> KnownDistance:
    """Return what `"A B 2.5m"` says: two names of photos and a length in mm, cm, m, km, in or ft.

    Names with blanks stand in quotation marks. Raises ValueError, which names the accepted form, for any other text.
    """
    form = (
        'write two names of photos and the distance of their cameras with its unit, as in "a.jpg b.jpg 2.5m"; names '
        "with blanks stand in quotation marks"
    )
    try:
        words = shlex.split(text)
    except ValueError:
        raise ValueError(f"{text[:80]!r} has an open quotation mark; {form}") from None
    if len(words) == 4:
        words = [*words[:2], " ".join(words[2:])]
    if len(words) != 3:
        raise ValueError(f"{text[:80]!r} is no distance between two photos; {form}")
    first, second, length = words
    match = _LENGTH.fullmatch(length.lower())
    if match is None or match[2] not in _METRES:
        raise ValueError(f"{length[:20]!r} is no length in {', '.join(_METRES)}; {form}")
    metres = float(match[1]) * _METRES[match[2]]
    if not 0.0 < metres < math.inf:
        raise ValueError(f"the distance between {first!r} and {second!r} is {length}; give one above zero")
    if first == second:
        raise ValueError(f"{first!r} is named twice; name two photos")
    return KnownDistance(first, second, metres)


class GeographicOrigin(Response):
    """Where the origin of a model lies on the earth (WGS 84)."""

    latitude: float = Field(description="Degrees, positive to the north.")
    longitude: float = Field(description="Degrees, positive to the east.")
    altitude: float | None = Field(
        default=None, description="Metres, as the photos give them; null where they give none."
    )


class ModelFrame(Response):
    """The coordinates of a model whose cameras were recovered from its photos. Also the contents of frame.json.

    x points to the right, y down and z to the front; with an `origin`, x points east and z north. The origin is what
    the cameras look at.
    """

    format: int = Field(default=1, description="Version of the format.")
    unit: Literal["metre", "arbitrary"] = Field(description="What a length of 1 is.")
    origin: GeographicOrigin | None = Field(
        default=None, description="Where the point (0, 0, 0) lies; null where GPS does not tell."
    )
    from_sfm: list[list[float]] = Field(
        description="Matrix, 4x4 by rows, from the coordinates of structure from motion to those of the model: a "
        "rotation times a scale, and a translation."
    )
    reasons: dict[str, str] = Field(
        default_factory=dict, description="Why: up, heading, origin and unit, a sentence each."
    )

"""Photos whose transparency contradicts that of the others: with nothing to see, or not cut out among cut-outs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from PIL import Image

from splatmill.schema.quantities import counted, listed

CLEAR = 12
"""Alpha of 255 up to which a photo shows nothing: programs that cut out objects leave faint haze."""

SOLID = 250
"""Alpha of 255 from which a pixel is opaque."""

NOTHING = "it is wholly transparent, so it shows nothing"

Extent = tuple[int, int]
"""The smallest and the largest alpha of a photo."""


def extent(photo: Image.Image) -> Extent:
    """The extent of a decoded photo; that of an opaque one where it has no alpha."""
    if photo.mode != "RGBA":
        return 255, 255
    values = np.asarray(photo.getchannel("A"))
    return int(values.min()), int(values.max())


def is_clear(alpha: Extent) -> bool:
    """Whether a photo shows nothing."""
    return alpha[1] <= CLEAR


def remarks(photos: Mapping[str, Extent]) -> list[str]:
    """A warning about opaque photos among cut-outs; none where the photos are of one kind.

    photos: the extent of each photo that is used.
    """
    opaque = [name for name, (low, _) in photos.items() if low >= SOLID]
    cut_out = len(photos) - len(opaque)
    if not cut_out or not opaque:
        return []
    few, kind = (
        (opaque, "opaque")
        if len(opaque) <= cut_out
        else ([name for name in photos if name not in set(opaque)], "partly transparent")
    )
    others = "have transparent parts" if kind == "opaque" else "are opaque"
    are = counted(len(few), "photo is", "photos are")
    return [
        f"{are} {kind}, and the other {len(photos) - len(few)} {others}: {listed(few)}. What surrounds an object is "
        "trained on in opaque photos, and not in cut-outs. Cut out all photos or none, unless the object fills these."
    ]

"""Pictures that are no photos by their pixels: masks, depth maps, normal maps and pictures of labels.

One such picture among photos may be a photo of something plain; a capture of nothing else holds no photos.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Literal

import numpy as np
from PIL import Image

from splatmill_worker.errors import Refusal

Kind = Literal["", "masks", "depth maps", "normal maps", "pictures of labels"]
"""What pictures seem to be; "" for photos."""

TRAITS: dict[str, str] = {
    "masks": "they are black and white, or of two colours",
    "depth maps": "they have a single channel of 16 bits",
    "normal maps": "their colours are directions of length 1",
    "pictures of labels": "they consist of a few colours",
}
"""By what each is recognised."""

MOST_LABELS = 24
"""Colours of a picture of labels, at most."""

NEAR = 12
"""Grey levels from black and white within which compression leaves the pixels of a mask."""

UNIT = 0.1
"""Deviation from 1 of the length of a normal in 8 bits per channel, compressed."""

MOST = 0.95
"""Share of the pixels that have the trait."""

LEAST_FRONT = 0.1
"""Share of the pixels of a normal map that are no background."""

SIDE = 256
"""Rows and columns of a picture that are read at most."""

GREY_16 = ("I;16", "I;16L", "I;16B", "I;16N")
"""Pillow's modes of pictures with a single channel of 16 bits."""


def kind_of(mode: str, photo: Image.Image) -> Kind:
    """Return what a decoded picture seems to be. mode: of the file, before it was converted."""
    if mode in GREY_16:
        return "depth maps"
    step = max(1, -(-max(photo.size) // SIDE))
    pixels = np.asarray(photo.convert("RGB"))[::step, ::step].reshape(-1, 3)
    colors = len(np.unique(pixels.astype(np.int32) @ np.array([65536, 256, 1])))
    if colors == 1:
        return ""
    grey = np.ptp(pixels.astype(np.int16), axis=1).max() <= NEAR
    level = pixels[:, 1]
    ends = level <= NEAR, level >= 255 - NEAR
    if colors == 2 or (grey and (ends[0] | ends[1]).mean() >= MOST and ends[0].any() and ends[1].any()):
        return "masks"
    if colors <= MOST_LABELS:
        return "pictures of labels"
    front = np.abs(pixels.astype(np.int16) - pixels.min(axis=1, keepdims=True)).max(axis=1) > NEAR
    if front.mean() < LEAST_FRONT:
        return ""
    lengths = np.linalg.norm(pixels[front] / 127.5 - 1.0, axis=1)
    return "normal maps" if (np.abs(lengths - 1.0) <= UNIT).mean() >= MOST else ""


def check(kinds: Mapping[str, Kind]) -> None:
    """Raise Refusal where no picture is a photo. kinds: of each picture, by its name."""
    if not kinds or "" in kinds.values():
        return
    counts = Counter(kinds.values())
    most = counts.most_common(1)[0][0]
    first = next(name for name, kind in kinds.items() if kind == most)
    what = " and ".join(counts)
    raise Refusal(
        "no_images",
        f"The {len(kinds)} pictures seem to be {what}, not photos: {TRAITS[most]} (such as {first}).",
        advice="Give the photos themselves, and masks in a folder `masks` beside them. If these are the photos, save "
        "them as JPEG in colour.",
    )

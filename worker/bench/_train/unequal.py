"""Photos of one scene as a camera takes them that sets its exposure for each: what fitting exposures is for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from splatmill_worker.images.guarded import own_picture

SPREAD = 0.3
"""Standard deviation of the natural logarithm of the exposure (0.3 is 0.43 stops)."""

EVERY = 8
"""Every n-th photo, in order of name, keeps its exposure: these are the held-out photos."""


def expose(folder: Path, seed: int = 0) -> None:
    """Multiply the values of every JPEG in `folder`, except the held-out ones, by a random exposure."""
    random = np.random.default_rng(seed)
    for number, path in enumerate(sorted(folder.glob("*.jpg"))):
        gain = float(np.exp(SPREAD * random.standard_normal()))
        if number % EVERY == 0:
            continue
        with own_picture(path) as photo:
            values, exif = np.asarray(photo, dtype=np.float32), photo.getexif()
        Image.fromarray((values * gain).clip(0, 255).round().astype(np.uint8)).save(
            path, quality=95, exif=exif
        )

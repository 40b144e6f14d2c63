"""A photo without a file, for what is decided by names, sizes and EXIF alone; and how alike two photos are."""

from pathlib import Path
from typing import Any

import numpy as np

from splatmill_worker.images import exif
from splatmill_worker.images.prepare import UsablePhoto


def usable(name: str, **tags: Any) -> UsablePhoto:
    return UsablePhoto(name, Path(name), name, 640, 480, exif.Exif(**tags))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """The PSNR in dB of two arrays of 8-bit levels."""
    return float(10 * np.log10(255**2 / np.square(a.astype(float) - b).mean()))

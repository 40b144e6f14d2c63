"""The held-out photos as they were compared: undistorted, at their size, masked pixels transparent."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from torch import Tensor

from splatmill.files import replacing
from splatmill.schema import HELD_OUT, format_bytes
from splatmill_worker.splat.views import Target, TrainingView

MOST_BYTES = 64_000_000
"""Bound on the bytes of all photos of a model. Lossless WebP takes about half of a byte to a byte a pixel."""

LARGEST_SIDE = 16383
"""Longest side of a WebP picture, pixels."""


def write_held_out(
    out: Path, views: Sequence[TrainingView], background: Tensor
) -> tuple[dict[str, str], list[tuple[str, str]]]:
    """Write the photos of the held-out views as lossless WebP files.

    out: folder of the model; the files lie in its folder held_out.
    views: the held-out views.
    background: RGB [3] in 0 to 1, behind photos that are transparent.

    Returns the files, relative to `out`, by the photo's name; and for each photo without one its name and the reason.
    """
    folder = out / HELD_OUT
    shutil.rmtree(folder, ignore_errors=True)
    files: dict[str, str] = {}
    missing: list[tuple[str, str]] = []
    total = 0
    for index, view in enumerate(views):
        height, width = view.full.rgb.shape[:2]
        if max(height, width) > LARGEST_SIDE:
            missing.append((view.name, f"it is larger than {LARGEST_SIDE} pixels, which WebP cannot hold."))
            continue
        folder.mkdir(exist_ok=True)
        name = f"{HELD_OUT}/{index:03d}.webp"
        with replacing(out / name) as part:
            # Method 0 takes 45 ms a megapixel, and the default one twenty times that for a tenth fewer bytes.
            Image.fromarray(_pixels(view.full, background)).save(
                part, "WEBP", lossless=True, exact=True, method=0, quality=20
            )
        size = (out / name).stat().st_size
        if total + size > MOST_BYTES:
            (out / name).unlink()
            missing.append((view.name, f"the photos before it fill the {format_bytes(MOST_BYTES)} for them."))
            continue
        total += size
        files[view.name] = name
    return files, missing


def _pixels(target: Target, background: Tensor) -> npt.NDArray[np.uint8]:
    """The photo uint8 [H, W, 3], or [H, W, 4] with an alpha of 0 at the pixels that do not count."""
    rgb = target.over(background).cpu().numpy()
    if target.mask is None:
        return rgb
    counted = np.where(target.mask.cpu().numpy(), 255, 0).astype(np.uint8)
    return np.concatenate([rgb, counted[..., None]], axis=2)

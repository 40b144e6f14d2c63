"""How well the report finds what passes by, where it was planted and every pixel of it is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from _rows import Row

from splatmill_worker.images.guarded import own_picture
from splatmill_worker.splat.train.disagreement import Disagreement


def judged(truth: Path, photos: Sequence[Disagreement]) -> Row | None:
    """Precision and recall, in pixels, of the outliers of `photos` against the pictures in the folder `truth`.

    The third value is the share of the pixels that movers changed. A photo without a picture shows no mover. None
    without that folder; the precision is None where no pixel was found.
    """
    if not truth.is_dir():
        return None
    outliers = right = there = 0.0
    for photo in photos:
        outliers += photo.share
        path = (truth / photo.name).with_suffix(".png")
        if path.is_file():
            whole = torch.from_numpy(np.asarray(own_picture(path), dtype=np.float32))
            size = tuple(photo.outliers.shape)
            moved = torch.nn.functional.interpolate(whole[None, None], size=size, mode="area")[0, 0] >= 0.5
            there += float(moved.float().mean())
            right += float((photo.outliers & moved).float().mean())
    return {
        "precision": right / outliers if outliers else None,
        "recall": right / there if there else None,
        "planted": there / len(photos) if photos else None,
    }

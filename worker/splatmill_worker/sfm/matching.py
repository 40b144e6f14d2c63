"""Which features of two photos look alike: all dot products at once, the ratio test, and mutual agreement.

Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", 2004. One matrix product per pair on the
BLAS of torch, an order of magnitude faster here than an approximate index per photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.sfm.features import Features

MAX_RATIO = 0.8  # of the angle to the best over the angle to the second best
MAX_ANGLE = 0.7  # radians
ROWS = 256  # of the products at once: they stay in the cache between the passes over them
KEPT = 256  # photos whose descriptors are kept as floats

Matches = npt.NDArray[np.uint32]


class Matcher:
    """Matches pairs of photos by index; `strongest` keeps only that many features of each, the largest ones."""

    def __init__(self, features: Sequence[Features], strongest: int | None = None) -> None:
        self._features = features
        self._strongest = strongest
        self._directions = lru_cache(KEPT)(self._directions_of)

    def match(self, first: int, second: int) -> Matches:
        """Pairs of feature indices [m,2] of photos `first` and `second`."""
        kept_a, a = self._directions(first)
        kept_b, b = self._directions(second)
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.uint32)
        best = np.empty(len(a), np.int64)
        value, second_value = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
        best_of_column = np.full(len(b), -1.0, np.float32)
        for start in range(0, len(a), ROWS):
            # numpy's argmax over rows and its maxima are vectorised; torch's maxima with indices are not.
            products = (a[start : start + ROWS] @ b.T).numpy()
            rows = slice(start, start + len(products))
            best[rows] = products.argmax(axis=1)
            at = np.arange(len(products)), best[rows]
            value[rows] = products[at]
            np.maximum(best_of_column, products.max(axis=0), out=best_of_column)
            products[at] = -1.0
            second_value[rows] = products.max(axis=1)
        mutual = value == best_of_column[best]
        angle = np.arccos(np.clip(value, -1.0, 1.0))
        clear = angle < MAX_RATIO * np.arccos(np.clip(second_value, -1.0, 1.0))
        good = np.flatnonzero(mutual & clear & (angle < MAX_ANGLE))
        return np.stack([kept_a[good], kept_b[best[good]]], axis=1).astype(np.uint32)

    def _directions_of(self, photo: int) -> tuple[npt.NDArray[np.int64], torch.Tensor]:
        """Indices of the features used, and their descriptors [n,128] at unit length."""
        features = self._features[photo]
        kept = np.arange(len(features.scales))
        if self._strongest is not None and len(kept) > self._strongest:
            kept = np.sort(np.argpartition(-features.scales, self._strongest)[: self._strongest])
        descriptors = torch.from_numpy(features.descriptors[kept].astype(np.float32))
        return kept, torch.nn.functional.normalize(descriptors, dim=1)

"""Feature matching by exhaustive comparison, with the ratio test and a cross-check.

Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004. All dot products of a pair of photos are
one matrix product in torch's BLAS (decisions: EXHAUSTIVE_MATCHING).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.sfm.sift import Features

MAX_RATIO = 0.8
"""Largest angle to the nearest descriptor, as a share of the angle to the second nearest (Lowe's ratio test)."""

MAX_ANGLE = 0.7
"""Radians between the descriptors of a match; COLMAP's default."""

ROWS = 256
"""Rows of the matrix of dot products that are computed at a time, so that they stay in the cache."""

CACHED_BYTES = 64 * 2**20
"""Size of the descriptors that are kept as normalised floats, at most: 80 photos of the lean effort, 20 of the highest.
To normalise those of a photo again takes a fiftieth of the time in which they are compared."""

Matches = npt.NDArray[np.uint32]


class Matcher:
    """Matches photos, given by their index in `features`.

    max_features: use only this many features of each photo, those with the largest scale. None uses all.
    """

    def __init__(self, features: Sequence[Features], max_features: int | None = None) -> None:
        self._features = features
        counts = [len(photo.scales) for photo in features]
        self._most = [count if max_features is None else min(count, max_features) for count in counts]
        most = max([1, *self._most])
        # Two are compared at a time in each thread.
        self._directions = lru_cache(max(2, CACHED_BYTES // (most * 128 * 4)))(self._directions_of)

    def match(self, first: int, second: int) -> Matches:
        """Indices [m,2] of the matching features of photos `first` and `second`."""
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
        distinct = angle < MAX_RATIO * np.arccos(np.clip(second_value, -1.0, 1.0))
        good = np.flatnonzero(mutual & distinct & (angle < MAX_ANGLE))
        return np.stack([kept_a[good], kept_b[best[good]]], axis=1).astype(np.uint32)

    def _directions_of(self, photo: int) -> tuple[npt.NDArray[np.int64], torch.Tensor]:
        """Indices [n] of the features used, and their descriptors [n,128] as unit vectors."""
        features = self._features[photo]
        kept, most = np.arange(len(features.scales)), self._most[photo]
        if len(kept) > most:
            kept = np.sort(np.argpartition(-features.scales, most)[:most])
        descriptors = torch.from_numpy(features.descriptors[kept].astype(np.float32))
        return kept, torch.nn.functional.normalize(descriptors, dim=1)

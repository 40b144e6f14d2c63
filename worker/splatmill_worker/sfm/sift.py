"""SIFT features of a picture, found by OpenCV.

Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004, on the picture at twice its size.
Descriptors are the square roots of those whose sum is one, as COLMAP's are (Arandjelović and Zisserman, "Three things
everyone should know to improve object retrieval", CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from threading import BoundedSemaphore

import numpy as np
import numpy.typing as npt

from splatmill_worker import memory
from splatmill_worker.opencv import SIFT

LEAST_CONTRAST = 0.008
"""Contrast of a feature with its surroundings, as a share of white, times the three layers of an octave; COLMAP's is
2.5 times as much. The features of the most contrast are kept, so faint ones count only where there are few others
(decisions: sift)."""

DESCRIPTOR_SCALE = 512.0
"""Length of a descriptor, whose elements are bytes; COLMAP's."""

BYTES_PER_PIXEL = 240
"""Memory that a search takes for each pixel: eleven pictures of floats at twice the size, and a third as much for all
smaller octaves."""

MEMORY_SHARE = 0.5
"""Share of the available memory that all searches at a time may take."""


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo.

    points: positions [n,2] in pixels of the reduced photo; the centre of its first pixel is at (0.5, 0.5).
    scales: [n], in pixels of the reduced photo.
    descriptors: uint8 [n,128].
    """

    points: npt.NDArray[np.float64]
    scales: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]


def concurrent_searches(pixels: int) -> int:
    """How many pictures of that many pixels may be searched at a time, at least one."""
    return max(1, int(MEMORY_SHARE * memory.available() / (BYTES_PER_PIXEL * pixels)))


def search_slots(sizes: Iterable[tuple[int, int]]) -> BoundedSemaphore:
    """A slot for each search that may run at a time, of pictures of these widths and heights."""
    return BoundedSemaphore(concurrent_searches(max((width * height for width, height in sizes), default=1)))


def find(
    grey: npt.NDArray[np.uint8],
    mask: npt.NDArray[np.uint8] | None,
    most: int,
    *,
    one_orientation: bool = False,
) -> Features:
    """The features with the most contrast in a picture, at most `most`, where the mask is not zero.

    grey: uint8 [h,w].
    mask: uint8 [h,w]; None: everywhere.
    one_orientation: give a place with several dominant orientations one feature, not one for each.

    A call uses one thread, and BYTES_PER_PIXEL bytes of memory for each pixel.
    """
    # OpenCV would keep `most` before it applies a mask. Its precise enlargement keeps places; the other one moves all
    # of them by a quarter of a pixel.
    any_may_count = mask is None and not one_orientation
    detector = SIFT.create(
        nfeatures=most if any_may_count else 0,
        contrastThreshold=LEAST_CONTRAST,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = detector.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros((0, 128), np.uint8))
    rows = np.array([(*each.pt, each.size, each.response) for each in keypoints], np.float32)
    kept = np.arange(len(rows))
    if mask is not None:
        column, row = (rows[:, :2] + 0.5).astype(np.int64).T
        kept = np.flatnonzero(mask[row, column])
    if one_orientation:
        kept = kept[np.unique(rows[kept, :3], axis=0, return_index=True)[1]]
    strongest = np.sort(kept[np.argsort(-rows[kept, 3], kind="stable")[:most]])
    sums = np.maximum(descriptors[strongest].sum(axis=1, keepdims=True), 1.0)
    return Features(
        rows[strongest, :2].astype(np.float64) + 0.5,
        rows[strongest, 2] / 2.0,
        (DESCRIPTOR_SCALE * np.sqrt(descriptors[strongest] / sums)).round().clip(0, 255).astype(np.uint8),
    )

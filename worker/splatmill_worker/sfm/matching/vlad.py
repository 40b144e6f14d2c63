"""One global descriptor per photo, whose cosine similarity ranks which photos may overlap.

VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010): sums of the
residuals of a photo's SIFT descriptors to the centres of a codebook, which is trained on the capture itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.sfm.sift import Features

WORDS = 32
"""Centres of the codebook; a photo's descriptor has 128 components for each."""

CODEBOOK_SAMPLE = 20_000
"""Descriptors on which the codebook is trained: evenly spaced ones, fewer than twice this number."""

KMEANS_ITERATIONS = 8
"""Iterations of k-means."""

PHOTO_FEATURES = 512
"""Features of a photo that are used, those with the largest scale."""


def similarities(features: Sequence[Features]) -> npt.NDArray[np.float32]:
    """Cosine similarities [n,n] of the photos' VLAD descriptors."""
    codebook = _codebook(_sample(features))
    vectors = torch.stack([_vlad(_largest(photo), codebook) for photo in features])
    return np.asarray((vectors @ vectors.T).numpy())


def _sample(features: Sequence[Features]) -> torch.Tensor:
    """CODEBOOK_SAMPLE descriptors or somewhat more, evenly spaced over those of all photos, of which one is held at a
    time: those of 5,000 photos take 1.3 GB."""
    counts = [min(PHOTO_FEATURES, len(photo.scales)) for photo in features]
    step = max(1, sum(counts) // CODEBOOK_SAMPLE)
    starts = [0, *accumulate(counts)]
    return torch.cat(
        [_largest(photo)[-start % step :: step] for start, photo in zip(starts, features, strict=False)]
    )


def _largest(photo: Features) -> torch.Tensor:
    """Descriptors [n,128], as unit vectors, of the photo's features with the largest scale."""
    kept = np.argsort(-photo.scales, kind="stable")[:PHOTO_FEATURES]
    return torch.nn.functional.normalize(torch.from_numpy(photo.descriptors[kept].astype(np.float32)), dim=1)


def _codebook(sample: torch.Tensor) -> torch.Tensor:
    """Centres [WORDS,128] of the descriptors by k-means; initial centres are evenly spaced, so that runs agree."""
    centers = sample[:: max(1, len(sample) // WORDS)][:WORDS].clone()
    for _ in range(KMEANS_ITERATIONS):
        word = (sample @ centers.T - 0.5 * centers.square().sum(1)).argmax(1)
        sums = torch.zeros_like(centers).index_add_(0, word, sample)
        counts = torch.bincount(word, minlength=len(centers)).unsqueeze(1)
        centers = torch.where(counts > 0, sums / counts.clamp(min=1), centers)
    return centers


def _vlad(descriptors: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    """The photo's descriptor [WORDS * 128]: residuals summed per word, each word normalised, then the whole."""
    word = (descriptors @ centers.T - 0.5 * centers.square().sum(1)).argmax(1)
    sums = torch.zeros_like(centers).index_add_(0, word, descriptors - centers[word])
    return torch.nn.functional.normalize(torch.nn.functional.normalize(sums, dim=1).flatten(), dim=0)

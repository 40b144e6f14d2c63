"""One small descriptor per photo, to tell which photos may show the same things.

VLAD (Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010): the
residuals of the photo's SIFT descriptors to a codebook learnt on the capture itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.sfm.features import Features

WORDS = 32
SAMPLE = 20_000  # descriptors the codebook is learnt on
ROUNDS = 8
PER_PHOTO = 512  # the largest features of each photo


def similarities(features: Sequence[Features]) -> npt.NDArray[np.float32]:
    """Cosines [n,n] between the photos' descriptors."""
    largest = [_largest(photo) for photo in features]
    codebook = _codebook(torch.cat(largest))
    vectors = torch.stack([_vlad(photo, codebook) for photo in largest])
    return np.asarray((vectors @ vectors.T).numpy())


def _largest(photo: Features) -> torch.Tensor:
    """The descriptors [n,128] of the photo's largest features at unit length."""
    kept = np.argsort(-photo.scales, kind="stable")[:PER_PHOTO]
    return torch.nn.functional.normalize(torch.from_numpy(photo.descriptors[kept].astype(np.float32)), dim=1)


def _codebook(descriptors: torch.Tensor) -> torch.Tensor:
    """k-means centres [WORDS,128]; evenly spaced samples and starts, so that it is the same every time."""
    step = max(1, len(descriptors) // SAMPLE)
    sample = descriptors[::step]
    centers = sample[:: max(1, len(sample) // WORDS)][:WORDS].clone()
    for _ in range(ROUNDS):
        word = (sample @ centers.T - 0.5 * centers.square().sum(1)).argmax(1)
        sums = torch.zeros_like(centers).index_add_(0, word, sample)
        counts = torch.bincount(word, minlength=len(centers)).unsqueeze(1)
        centers = torch.where(counts > 0, sums / counts.clamp(min=1), centers)
    return centers


def _vlad(descriptors: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    """[words * 128]: residuals summed per word, each word at unit length, then the whole."""
    word = (descriptors @ centers.T - 0.5 * centers.square().sum(1)).argmax(1)
    sums = torch.zeros_like(centers).index_add_(0, word, descriptors - centers[word])
    return torch.nn.functional.normalize(torch.nn.functional.normalize(sums, dim=1).flatten(), dim=0)

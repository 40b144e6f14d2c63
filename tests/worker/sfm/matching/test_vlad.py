"""Proves that the codebook of global descriptors is trained on descriptors that are spread evenly over all photos.

Does not prove that photos which overlap have similar ones: `bench sfm` shows whether they are matched.
"""

import numpy as np
import pytest
import torch

from splatmill_worker.sfm.matching import vlad
from splatmill_worker.sfm.sift import Features


def photo(count: int, number: int) -> Features:
    descriptors = np.random.default_rng(number).integers(0, 256, (count, 128), np.uint8)
    return Features(np.zeros((count, 2)), np.arange(count, 0, -1, dtype=np.float32), descriptors)


@pytest.mark.parametrize("counts", [[30, 0, 7, 55, 1, 40], [0, 3], [600, 20]], ids=str)
def test_the_sample_is_every_so_many_of_all(counts: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vlad, "CODEBOOK_SAMPLE", 20)
    photos = [photo(count, number) for number, count in enumerate(counts)]
    largest = [each.descriptors[: vlad.PHOTO_FEATURES].astype(np.float32) for each in photos]
    everything = torch.nn.functional.normalize(torch.from_numpy(np.concatenate(largest)), dim=1)
    step = max(1, len(everything) // 20)
    np.testing.assert_array_equal(vlad._sample(photos), everything[::step])


def test_one_photo_at_a_time_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the descriptors as floats: those of 5,000 photos would take more than a gigabyte."""
    held = 0
    most = 0

    class Counted:
        def __init__(self, features: Features) -> None:
            nonlocal held, most
            self.tensor = whole(features)
            held += 1
            most = max(most, held)

        def __getitem__(self, part: slice) -> torch.Tensor:
            return self.tensor[part].clone()

        def __del__(self) -> None:
            nonlocal held
            held -= 1

    whole = vlad._largest
    monkeypatch.setattr(vlad, "_largest", Counted)
    vlad._sample([photo(600, number) for number in range(30)])
    assert most <= 2

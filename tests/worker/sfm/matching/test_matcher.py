"""Proves that matches are the mutual nearest descriptors that pass the ratio test, against a direct computation.

Does not prove speed, nor that true matches of photos pass.
"""

import numpy as np

from splatmill_worker.sfm.matching.matcher import CACHED_BYTES, MAX_ANGLE, MAX_RATIO, Matcher
from splatmill_worker.sfm.sift import Features


def random_features(count: int, seed: int) -> Features:
    random = np.random.default_rng(seed)
    descriptors = random.integers(0, 256, (count, 128), np.uint8)
    return Features(
        random.uniform(0, 500, (count, 2)), random.uniform(1, 9, count).astype(np.float32), descriptors
    )


def test_matches_are_the_mutual_nearest_that_pass_the_ratio_test() -> None:
    a, b = random_features(300, 1), random_features(700, 2)
    noise = np.random.default_rng(3).integers(-12, 13, (200, 128))
    b.descriptors[100:300] = np.clip(a.descriptors[:200].astype(int) + noise, 0, 255)
    b.descriptors[300:310] = b.descriptors[100:110]  # ten ambiguous ones
    matches = {tuple(row) for row in Matcher([a, b]).match(0, 1).tolist()}
    unit = [
        f.descriptors / np.linalg.norm(f.descriptors.astype(float), axis=1, keepdims=True) for f in (a, b)
    ]
    angles = np.arccos(np.clip(unit[0] @ unit[1].T, -1, 1))
    expected = set()
    for row in range(300):
        first, second = np.argsort(angles[row])[:2]
        if angles[:, first].argmin() == row and angles[row, first] < min(
            MAX_ANGLE, MAX_RATIO * angles[row, second]
        ):
            expected.add((row, int(first)))
    assert matches == expected
    assert matches == {(k, 100 + k) for k in range(10, 200)}


def test_descriptors_that_are_kept_stay_within_their_bound() -> None:
    for count, most in ((300, None), (300, 100), (6000, 6000)):
        photos = [random_features(count, 0)] * 3
        kept = Matcher(photos, most)._directions.cache_parameters()["maxsize"]
        assert 2 <= kept <= CACHED_BYTES / (min(count, most or count) * 128 * 4)

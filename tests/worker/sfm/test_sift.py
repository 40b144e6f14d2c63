"""Proves that features lie where a picture has blobs, have their size, avoid masked pixels, and are the strongest ones.

Does not prove that they are found again in another photo; the tests of reconstructions do.
"""

import subprocess
import sys

import numpy as np
import numpy.typing as npt
import pytest

from splatmill_worker.sfm import sift

WIDTH, HEIGHT = 320, 240

Grey = npt.NDArray[np.uint8]


def _blobs() -> tuple[Grey, npt.NDArray[np.float64]]:
    """A picture of bright Gaussian blobs, and their x, y and sigma in pixels, the fainter ones last."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    light = np.full((HEIGHT, WIDTH), 60.0)
    blobs = []
    for number in range(24):
        x, y = np.array([30 + 50 * (number % 6), 30 + 55 * (number // 6)]) + rng.random(2)
        sigma = rng.uniform(2, 5)
        blobs.append((x, y, sigma))
        light += (150 - 4 * number) * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    return light.clip(0, 255).round().astype(np.uint8), np.array(blobs)


def test_blobs_are_found_at_their_places_and_sizes() -> None:
    grey, blobs = _blobs()
    features = sift.find(grey, None, 1000)
    distances = np.linalg.norm(features.points - blobs[:, None, :2], axis=2)
    nearest = distances.argmin(axis=1)
    offsets = features.points[nearest] - blobs[:, :2]
    assert np.abs(offsets).max() < 0.1
    # The centre of the first pixel is at 0.5: no picture of half the pixels is shifted against another.
    np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=0.02)
    # The difference of Gaussians of sigma and 2^(1/3) sigma is largest where sigma is 2^(-1/6) times that of the blob.
    np.testing.assert_allclose(features.scales[nearest] / blobs[:, 2], 2 ** (-1 / 6), atol=0.03)


def test_descriptors_are_square_roots() -> None:
    grey, _ = _blobs()
    features = sift.find(grey, None, 1000)
    assert features.descriptors.dtype == np.uint8
    # The elements' squares sum to 512 squared, but for rounding.
    lengths = np.linalg.norm(features.descriptors.astype(np.float64), axis=1)
    np.testing.assert_allclose(lengths, 512.0, rtol=0.02)


def test_the_strongest_features_are_kept() -> None:
    grey, blobs = _blobs()
    few = sift.find(grey, None, 6)
    assert len(few.points) == 6
    distances = np.linalg.norm(few.points - blobs[:, None, :2], axis=2)
    assert set(distances.argmin(axis=0)) <= set(range(12))  # of the brighter half


def test_masked_pixels_have_no_features_and_take_no_place_of_others() -> None:
    grey, blobs = _blobs()
    mask = np.zeros(grey.shape, np.uint8)
    mask[HEIGHT // 2 :] = 255  # the fainter half
    assert len(sift.find(grey, mask, 12).points) == 12
    features = sift.find(grey, mask, 1000)
    assert (features.points[:, 1] >= HEIGHT // 2).all()
    distances = np.linalg.norm(features.points - blobs[12:, None, :2], axis=2)
    assert (distances.min(axis=1) < 0.1).all()


def test_a_place_has_one_feature_where_one_orientation_is_asked_for() -> None:
    grey, _ = _blobs()
    several = sift.find(grey, None, 10_000)
    places = np.unique(np.column_stack([several.points, several.scales]), axis=0)
    assert len(places) < len(several.points)
    one = sift.find(grey, None, len(places), one_orientation=True)
    np.testing.assert_array_equal(np.unique(np.column_stack([one.points, one.scales]), axis=0), places)


def test_a_mask_that_shows_everything_changes_nothing() -> None:
    grey, _ = _blobs()
    for most in (7, 20, 1000):
        bare, masked = sift.find(grey, None, most), sift.find(grey, np.full_like(grey, 255), most)
        # Their order differs, and which orientation of a place is kept.
        np.testing.assert_array_equal(np.unique(bare.points, axis=0), np.unique(masked.points, axis=0))
    np.testing.assert_array_equal(np.unique(bare.descriptors, axis=0), np.unique(masked.descriptors, axis=0))


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (3, 2), (HEIGHT, WIDTH)])
def test_a_picture_without_contrast_or_size_has_no_features(shape: tuple[int, int]) -> None:
    for mask in (None, np.full(shape, 255, np.uint8), np.zeros(shape, np.uint8)):
        features = sift.find(np.full(shape, 128, np.uint8), mask, 100)
        assert features.points.shape == (0, 2)
        assert features.scales.shape == (0,)
        assert features.descriptors.shape == (0, 128)


def test_pictures_are_searched_at_a_time_as_the_memory_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    panorama = 4200 * 2100
    for gigabytes, expected in ((0, 1), (1, 1), (8, 1), (9, 2), (90, 21)):
        monkeypatch.setattr("splatmill_worker.memory.available", lambda size=gigabytes: size * 10**9)
        assert sift.concurrent_searches(panorama) == expected


@pytest.mark.skipif(sys.platform != "linux", reason="the most memory that a program took is read from /proc")
def test_a_search_takes_no_more_memory_than_it_counts_on() -> None:
    code = (
        "import re, numpy as np; from splatmill_worker.sfm import sift;"
        "most = lambda: int(re.search(r'VmHWM:\\s+(\\d+) kB', open('/proc/self/status').read())[1]);"
        "grey = np.random.default_rng(0).integers(0, 2, (1000, 2000)).astype(np.uint8);"
        "sift.find(grey[:99, :99], None, 1);"
        "before = most();"
        "sift.find(grey, None, 1000);"
        "print(most() - before)"
    )
    grown = int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)
    assert 0.8 < grown * 1024 / (1000 * 2000 * sift.BYTES_PER_PIXEL) < 1.1

"""Proves which figures refuse a model, under which code, and that the message holds the figures and what is needed.

Does not prove that the thresholds are right; `test_reconstruct` refuses real photos by them.
"""

from typing import Any

import pytest

from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm import checks
from splatmill_worker.sfm.matching.two_view import ROTATION_CONFIGURATIONS, TwoView

GOOD: dict[str, Any] = {
    "photos": 20,
    "registered": 18,
    "points": 900,
    "parallax_degrees": 12.0,
    "pairs_matched": 100,
    "pairs_verified": 80,
    "pairs_turned_only": 3,
}


@pytest.mark.parametrize(("count", "least"), [(3, 3), (5, 3), (10, 5), (11, 4), (20, 6), (100, 30)])
def test_half_of_a_small_set_and_a_third_of_a_large_one_must_be_registered(count: int, least: int) -> None:
    assert checks.min_registered(count) == least


def test_good_figures_are_accepted() -> None:
    checks.require_usable(GOOD)


@pytest.mark.parametrize(
    ("changed", "code", "said"),
    [
        ({"registered": 5}, "sfm_too_few_registered", ["5 of 20 photos", "at least 6 photos"]),
        ({"points": 40}, "sfm_too_few_registered", ["40 points", "60 points", "80 of 100 pairs"]),
        ({"registered": 2, "pairs_turned_only": 60}, "sfm_no_parallax", ["60 of the 80 pairs"]),
        ({"parallax_degrees": 0.4}, "sfm_no_parallax", ["0.4 degrees", "1.5"]),
    ],
)
def test_bad_figures_are_refused_with_what_is_needed(
    changed: dict[str, Any], code: str, said: list[str]
) -> None:
    with pytest.raises(SfmFailed) as failed:
        checks.require_usable(GOOD | changed)
    assert failed.value.code == code
    assert failed.value.facts["photos"] == 20
    for words in said:
        assert words in failed.value.message
    assert failed.value.advice


def test_facts_of_pairs_count_the_verified_ones() -> None:
    turned = ROTATION_CONFIGURATIONS[0]
    pairs = {(0, 1): TwoView(50, 30, 2), (0, 2): TwoView(40, 14, 2), (1, 2): TwoView(90, 60, turned)}
    assert checks.pair_facts(pairs) == {
        "pairs_matched": 3,
        "pairs_verified": 2,
        "inliers_per_pair": 45.0,
        "pairs_turned_only": 1,
    }

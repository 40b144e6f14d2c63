"""Proves what the last doubling of the steps is found to have gained on validation photos, whatever held-out ones say.

Does not prove that stopping there saves time on real photos.
"""

from __future__ import annotations

from splatmill_worker.splat.train.curve import CurvePoint, validated
from splatmill_worker.splat.train.curve import last_gain as gain_of


def curve(*scores: float | None, every: int = 100) -> list[CurvePoint]:
    """Points of so many steps, one second apart; held-out photos gain all the time."""
    return [
        CurvePoint(
            seconds=float(i + 1),
            step=every * (i + 1),
            loss=0.1,
            psnr=20.0 + i,
            ssim=None,
            gaussians=1,
            validation_psnr=score,
        )
        for i, score in enumerate(scores)
    ]


def last_gain(points: list[CurvePoint], since: int = 0) -> float | None:
    return gain_of(validated(points, since))


def test_the_mean_of_the_second_half_is_compared_with_that_of_the_second_quarter() -> None:
    assert last_gain(curve(20.0, 24.0, 26.0, 27.0, 27.5, 27.25)) == 2.25
    assert last_gain(curve(40.0, 28.0, 27.0, 27.0, 27.5, 27.25)) == -0.25


def test_one_point_that_happens_to_be_high_is_no_loss_of_those_after_it() -> None:
    assert last_gain(curve(24.0, 25.0, 28.0, 26.75, 27.0, 27.25, 27.0)) == 0.5


def test_points_on_all_photos_say_nothing_and_do_not_count() -> None:
    assert last_gain(curve(20.0, 24.0, 26.0, 27.0, 27.5, 27.25, None)) == 2.25


def test_points_on_reduced_photos_are_not_compared() -> None:
    points = curve(20.0, 29.0, 26.0, 27.0, 27.5, 27.25)
    assert last_gain(points) == -0.25
    assert last_gain(points, since=200) == 1.25
    assert last_gain(points, since=300) is None


def test_too_few_points_or_steps_or_no_validation_views_are_no_evidence() -> None:
    assert last_gain(curve(20.0, 24.0, 26.0, 27.0)) is None
    assert last_gain(curve(20.0, 24.0, every=400)) is None
    assert last_gain(curve(20.0, 24.0, 26.0, 27.0, 27.5, 27.25, every=80)) is None
    assert last_gain(curve(*[None] * 10)) is None
    assert last_gain([]) is None

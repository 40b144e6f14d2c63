"""Proves when a curve of validation PSNR counts as flat, whatever the held-out PSNR does.

Does not prove that stopping there saves time on real photos.
"""

from __future__ import annotations

from collections.abc import Sequence

from splatmill_worker.splat.train.curve import CurvePoint, is_flat


def curve(*scores: float | None, first_step: int = 1000) -> list[CurvePoint]:
    """Points one second apart."""
    return [
        CurvePoint(
            seconds=float(i + 1),
            step=first_step + i,
            loss=0.1,
            psnr=20.0 + i,
            ssim=None,
            gaussians=1,
            validation_psnr=score,
        )
        for i, score in enumerate(scores)
    ]


RISING: Sequence[float] = (20.0, 21.0, 22.0, 23.0, 24.0, 25.0, 26.0, 27.0, 28.0, 29.0)
FLAT: Sequence[float] = (20.0, 24.0, 26.0, 27.0, 28.0, 28.0, 28.0, 28.0, 28.01, 28.0)


def test_a_curve_that_gains_nothing_over_the_last_points_is_flat() -> None:
    assert is_flat(curve(*FLAT))
    assert not is_flat(curve(*RISING))


def test_one_gain_above_the_limit_is_enough_to_go_on() -> None:
    assert not is_flat(curve(*FLAT[:-2], 28.03, 28.0))


def test_too_few_points_or_steps_or_no_validation_views_are_no_evidence() -> None:
    assert not is_flat(curve(28.0, 28.0, 28.0))
    assert not is_flat(curve(*FLAT, first_step=10))
    assert not is_flat(curve(*[None] * 10))
    assert not is_flat([])

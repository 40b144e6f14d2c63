"""When photos become larger and Gaussians are added: counted in steps that have a Gaussian in view.

`share` is how often a step has a given Gaussian in view, over how often it does where photos have half of the scene in
view: 0 to 1 (`share_in_view`). Two captures side by side, trained together for twice the steps, then have the course
that each has alone (decisions: steps-in-view). Each number has a limit by the steps alone, for runs that show too
little of a scene and for forecasts that are wrong.
"""

from __future__ import annotations


def resolution(steps: int, share: float, image_size: int) -> tuple[tuple[int, int], ...]:
    """Coarse to fine: a quarter of the photos' size first, then half, then all of it (decisions: coarse-to-fine)."""
    first = _stretched(max(20, min(200, steps * share // 8)), share, max(20, steps // 8))
    second = _stretched(max(50, min(500, steps * share // 3)), share, max(50, steps // 3))
    if image_size < 240:
        return ((0, 2), (second, 1))
    return ((0, 4), (first, 2), (second, 1))


def densification(steps: int, share: float) -> tuple[int, int]:
    """The first step after which Gaussians are added, and the steps between two additions."""
    first = _stretched(max(50, min(300, steps * share // 8)), share, max(50, steps // 4))
    every = _stretched(max(40, min(100, steps * share // 20)), share, max(40, steps // 8))
    return first, every


def _stretched(in_view: float, share: float, most: int) -> int:
    """The number of steps of which so many have a Gaussian in view, at most `most`."""
    return min(most, round(in_view / share))

"""How far a picture has moved from one frame of a video to another: dense Lucas-Kanade in a pyramid, for small ones.

Lucas and Kanade, "An iterative image registration technique", IJCAI 1981; Bouguet, "Pyramidal implementation of the
Lucas Kanade feature tracker", 2000.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Grey = npt.NDArray[np.float32]

RADIUS = 3
"""Half side, in pixels, of the window within which all pixels are taken to move alike."""

NOISE = 4.0
"""Squared gradient, in (grey levels per pixel) squared, that noise alone produces. It is added to the diagonal of the
normal equations, so that where gradients are weaker the flow stays at that of the coarser level."""

COARSEST = 16
"""Least number of pixels of the shorter side of a halved picture: on it, a motion of a quarter of the picture is some
pixels."""

ROUNDS = 3
"""Rounds of refinement on a level."""


def displacement(first: Grey, second: Grey) -> float:
    """The mean length of the optical flow from `first` to `second`, as a share of the longer side.

    Both are [H,W] in grey levels 0 to 255. Pixels that leave the picture do not count. The answer says nothing where
    the two have nothing in common, but lies between 0 and 1 there too. Raises ValueError for pictures of two sizes.
    """
    if first.shape != second.shape:
        raise ValueError(
            f"pictures of {first.shape} and {second.shape} pixels were given; give two of one size."
        )
    firsts, seconds = _pyramid(first), _pyramid(second)
    flow = np.zeros((2, *firsts[-1].shape), np.float32)
    for before, after in zip(firsts[::-1], seconds[::-1], strict=True):
        flow = _refined(before, after, _enlarged(flow, before.shape))
    height, width = first.shape
    y, x = np.mgrid[:height, :width] + flow[::-1]
    stays = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    if not stays.any():
        return 1.0
    return float(min(np.hypot(*flow)[stays].mean() / max(height, width), 1.0))


def _refined(before: Grey, after: Grey, flow: Grey) -> Grey:
    """The flow [2,H,W] in pixels (x, y) after ROUNDS steps of Gauss-Newton from `flow`, window by window."""
    height, width = before.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    gradient_y, gradient_x = (np.asarray(each, np.float32) for each in np.gradient(before))
    xx, xy, yy = (_window_mean(each) for each in (gradient_x**2, gradient_x * gradient_y, gradient_y**2))
    xx, yy = xx + NOISE, yy + NOISE
    determinant = xx * yy - xy * xy
    for _ in range(ROUNDS):
        error = sampled(after, y + flow[1], x + flow[0]) - before
        right, down = _window_mean(gradient_x * error), _window_mean(gradient_y * error)
        step = np.stack([yy * right - xy * down, xx * down - xy * right]) / determinant
        flow = flow - step.astype(np.float32)
    return flow


def _pyramid(picture: Grey) -> list[Grey]:
    """The picture, and its halves down to COARSEST."""
    levels = [picture.astype(np.float32)]
    while min(levels[-1].shape) >= 2 * COARSEST:
        fine = levels[-1][: levels[-1].shape[0] // 2 * 2, : levels[-1].shape[1] // 2 * 2]
        halved: Grey = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]) / np.float32(4)
        levels.append(halved)
    return levels


def _enlarged(flow: Grey, shape: tuple[int, ...]) -> Grey:
    """The flow of the next coarser level, or of this one, on a level of `shape`."""
    if flow.shape[1:] == shape:
        return flow
    twice = 2 * flow.repeat(2, axis=1).repeat(2, axis=2)
    more = [(0, 0), *((0, side - had) for side, had in zip(shape, twice.shape[1:], strict=True))]
    return np.pad(twice, more, mode="edge")


def _window_mean(values: Grey) -> Grey:
    """The mean over the window around each pixel; the border is continued outwards."""
    side = 2 * RADIUS + 1
    sums = np.pad(values, RADIUS, mode="edge").cumsum(0).cumsum(1)
    sums = np.pad(sums, ((1, 0), (1, 0)))
    mean: Grey = (
        sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    ) / side**2
    return mean


def sampled(picture: Grey, y: npt.NDArray[np.floating[Any]], x: npt.NDArray[np.floating[Any]]) -> Grey:
    """A picture [H,W] at fractional pixels, by bilinear interpolation; outside, that of the nearest pixel."""
    height, width = picture.shape
    y, x = np.clip(y, 0, height - 1.001), np.clip(x, 0, width - 1.001)
    row, column = y.astype(np.intp), x.astype(np.intp)
    down, right = y - row, x - column
    at, flat = row * width + column, picture.ravel()
    above = flat[at] * (1 - right) + flat[at + 1] * right
    below = flat[at + width] * (1 - right) + flat[at + width + 1] * right
    mixed: Grey = above * (1 - down) + below * down
    return mixed

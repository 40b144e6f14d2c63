"""Which Gaussians a selection holds, by their centres.

The page computes the same in `viewer/selection.js`: both in float64 and with the same operations in the same order, so
that what people see selected is what an edit leaves out.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatmill.schema import Selection, Stroke

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SLACK = 1e-9
"""Share by which the bounds of a line are widened before what is outside of them is left out: roundings are smaller."""


def selected(means: npt.NDArray[np.float32], selection: Selection) -> Mask:
    """Return the Gaussians of a selection, bool [N]. means: centres [N, 3]."""
    chosen = np.zeros(len(means), dtype=bool)
    for stroke in selection.strokes:
        chosen[within(means, stroke)] = not stroke.subtract
    return ~chosen if selection.inverted else chosen


def within(means: npt.NDArray[np.float32], stroke: Stroke) -> npt.NDArray[np.intp]:
    """Return the indices of the Gaussians of a stroke."""
    matrix = np.array(stroke.camera_to_world, dtype=np.float64)
    right, down, forward, position = (matrix[:3, column] for column in range(4))
    x, y, z = (means[:, axis].astype(np.float64) - position[axis] for axis in range(3))
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is in no stroke
        depth = x * forward[0] + y * forward[1] + z * forward[2]
        ahead = np.flatnonzero((depth > 0) & (depth <= (np.inf if stroke.far is None else stroke.far)))
        x, y, z, depth = x[ahead], y[ahead], z[ahead], depth[ahead]
        u = (x * right[0] + y * right[1] + z * right[2]) / depth
        v = (x * down[0] + y * down[1] + z * down[2]) / depth
    line = np.array(stroke.points, dtype=np.float64)
    (low_u, high_u), (low_v, high_v) = (_bounds(values, stroke.radius or 0.0) for values in line.T)
    near = np.flatnonzero((u >= low_u) & (u <= high_u) & (v >= low_v) & (v <= high_v))
    # By rising v, each part of the line meets a slice of the Gaussians and not all of them.
    near = near[np.argsort(v[near])]
    u, v = u[near], v[near]
    inside = _inside(u, v, line) if stroke.radius is None else _brushed(u, v, line, stroke.radius)
    indices: npt.NDArray[np.intp] = ahead[near[inside]]
    return indices


def _bounds(values: Floats, radius: float) -> tuple[float, float]:
    """Return the least and greatest coordinate that a line holds."""
    low, high = float(values.min()), float(values.max())
    reach = radius + SLACK * (radius + max(abs(low), abs(high)))
    return low - reach, high + reach


def _inside(u: Floats, v: Floats, line: Floats) -> Mask:
    """Return the points in a closed line, by the even-odd rule. v: rising."""
    inside = np.zeros(len(u), dtype=bool)
    for (au, av), (bu, bv) in zip(line, np.roll(line, -1, axis=0), strict=True):
        low, high = min(av, bv), max(av, bv)
        meets = slice(np.searchsorted(v, low, "left"), np.searchsorted(v, high, "left"))
        if low < high:
            inside[meets] ^= u[meets] < (bu - au) * (v[meets] - av) / (bv - av) + au
    return inside


def _brushed(u: Floats, v: Floats, line: Floats, radius: float) -> Mask:
    """Return the points that are at most `radius` from a line. v: rising."""
    brushed = np.zeros(len(u), dtype=bool)
    for (au, av), (bu, bv) in zip(line, line[1:] if len(line) > 1 else line, strict=False):
        low, high = _bounds(np.array([av, bv]), radius)
        near = slice(np.searchsorted(v, low, "left"), np.searchsorted(v, high, "right"))
        du, dv = bu - au, bv - av
        square = du * du + dv * dv
        pu, pv = u[near] - au, v[near] - av
        along = np.clip((pu * du + pv * dv) / square, 0.0, 1.0) if square > 0 else np.zeros(len(pu))
        qu, qv = pu - along * du, pv - along * dv
        brushed[near] |= qu * qu + qv * qv <= radius * radius
    return brushed

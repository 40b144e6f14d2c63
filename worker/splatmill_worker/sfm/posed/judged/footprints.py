"""Points thinned to what the photos resolve: one for the size that a pixel of the closest photo has at its place."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, View
from splatmill_worker.sfm.alignment.cells import in_cells
from splatmill_worker.sfm.callbacks import stop_if


def footprints(
    points: Float, views: Sequence[View], side: int | None, cancelled: Callable[[], bool] = lambda: False
) -> Float:
    """Size [n], in units of the scene, that a pixel of the photo that shows a point closest has at the point [n,3].

    It is infinite where no photo shows the point.

    side: pixels of the longest side of the photos, where they are reduced; None: their full size.
    """
    smallest = np.full(len(points), np.inf)
    for view in views:
        stop_if(cancelled)
        camera = view.camera
        projection = camera.project(points)
        reduced = 1.0 if side is None else min(1.0, side / max(camera.width, camera.height))
        rows = np.flatnonzero(projection.inside)
        sizes = projection.depths[rows] / (reduced * min(camera.fx, camera.fy))
        smallest[rows] = np.minimum(smallest[rows], sizes)
    return smallest


GROWTH = 2.0**0.5
"""Factor by which cells grow where too many points are left."""


def resolved(points: Float, sizes: Float, most: int) -> tuple[npt.NDArray[np.intp], float]:
    """Rows, in random order, of the points [n,3] that are shown, one of each cell as large as a pixel is there; and the
    pixels that a cell is wide, which are more where more than `most` points would be left.

    The order is random, so that a part of them is spread over the scene as well.

    sizes: of a pixel at each point [n], as `footprints` returns them. The sizes of cells are powers of two times a
        length, so that they do not overlap: 0.7 to 1.4 pixels.
    """
    shown = np.flatnonzero(np.isfinite(sizes) & (sizes > 0.0))
    random = np.random.default_rng(0)
    if not len(shown):
        return shown, 1.0
    shown = random.permutation(shown)
    cells, pixels = np.exp2(np.round(np.log2(sizes[shown]))), 1.0
    rows = in_cells(points[shown], cells)
    while len(rows) > most:
        pixels *= GROWTH
        rows = in_cells(points[shown], pixels * cells)
    return random.permutation(shown[rows]), pixels

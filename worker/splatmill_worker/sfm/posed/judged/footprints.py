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
        seen = camera.project(points)
        reduced = 1.0 if side is None else min(1.0, side / max(camera.width, camera.height))
        rows = np.flatnonzero(seen.inside)
        sizes = seen.depths[rows] / (reduced * min(camera.fx, camera.fy))
        smallest[rows] = np.minimum(smallest[rows], sizes)
    return smallest


def resolved(points: Float, sizes: Float) -> npt.NDArray[np.intp]:
    """Rows, in order, of the points [n,3] that are shown, one of each cell as large as a pixel is there.

    sizes: of a pixel at each point [n], as `footprints` returns them. The sizes of cells are powers of two, so that
        they do not overlap: 0.7 to 1.4 pixels.
    """
    shown = np.flatnonzero(np.isfinite(sizes) & (sizes > 0.0))
    if not len(shown):
        return shown
    cells = np.exp2(np.round(np.log2(sizes[shown])))
    rows: npt.NDArray[np.intp] = shown[in_cells(points[shown], cells)]
    return rows

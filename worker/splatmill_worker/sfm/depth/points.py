"""Points of depth maps: the pixels that count, in the world of the cameras, with the colours of their photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from splatmill_worker.images.load import load_view
from splatmill_worker.scene import Float, View
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.depth.pixels import DepthMap

MOST = 1_000_000
"""Pixels of all maps together that become points; of more, every second one across and down, and so on."""

OPAQUE = 128
"""Alpha from which a pixel of a photo shows something."""


def of_maps(
    maps: Sequence[DepthMap], views: Sequence[View], unit: float, cancelled: Callable[[], bool]
) -> tuple[Float, npt.NDArray[np.uint8]]:
    """Points [n,3] in the world and their colours RGB [n,3]. What a mask hides and what is transparent is left out.

    views: of the scene, which the indices of the maps refer to. unit: length of one level.

    Raises OSError and ValueError for photos as `load_view` does, and Cancelled.
    """
    step = max(1, int(np.ceil(np.sqrt(sum(each.levels.size for each in maps) / MOST))))
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for each in maps:
        stop_if(cancelled)
        view = views[each.index]
        rows, columns = np.nonzero(each.sure[step // 2 :: step, step // 2 :: step])
        rows, columns = rows * step + step // 2, columns * step + step // 2
        depths = unit * each.levels[rows, columns].astype(np.float64)
        local = each.local(view, rows, columns) * depths[:, None]
        photo = load_view(view, max(each.levels.shape))
        camera = photo.camera
        with np.errstate(invalid="ignore"):
            places = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
            kept = np.flatnonzero(((places >= 0.0) & (places < [camera.width, camera.height])).all(axis=1))
        x, y = places[kept].astype(np.intp).T
        shown = np.ones(len(kept), bool)
        if photo.mask is not None:
            shown &= photo.mask[y, x]
        if photo.alpha is not None:
            shown &= photo.alpha[y, x] >= OPAQUE
        points.append(camera.to_world(local[kept[shown]]))
        colors.append(photo.rgb[y[shown], x[shown]])
    return np.concatenate(points), np.concatenate(colors)

"""The pixels of a depth map: the rays that they look along, and where points of the scene fall on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Float, View

EDGE = 0.05
"""Difference to a neighbour, as a share of the distance, from which a pixel lies on an edge: its distance mixes two
surfaces there."""

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class DepthMap:
    """The depth map of a view.

    index: of the view in its scene.
    levels: distances along the optical axis as they are stored, and 0 where there is none, float32 [h,w].
    sure: which of them count: those of the highest confidence, and on no edge [h,w].
    """

    index: int
    levels: npt.NDArray[np.float32]
    sure: Flags

    def local(self, view: View, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> Float:
        """Points [n,3] in the frame of the camera of the view, at the depth 1, that pixels [n] look at."""
        height, width = self.levels.shape
        x, y = columns + 0.5, rows + 0.5
        if view.lens is None:
            x, y = view.camera.scaled_to(width, height).normalized(x, y)
        else:
            lens = view.lens
            camera = pycolmap.Camera(
                model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
            )
            on_lens = np.stack([x * lens.width / width, y * lens.height / height], axis=1)
            x, y = np.asarray(camera.cam_from_img(on_lens), np.float64).reshape(-1, 2).T
        return np.stack([x, y, np.ones_like(x)], axis=1)

    def at(self, view: View, points: Float) -> tuple[npt.NDArray[np.intp], Float, Float]:
        """Rows of the points [n,3] of the world that fall on pixels that count, their depths, and the levels there."""
        height, width = self.levels.shape
        local = view.camera.to_camera(points)
        ahead = np.flatnonzero(local[:, 2] > 0.0)
        local = local[ahead]
        if view.lens is None:
            camera = view.camera.scaled_to(width, height)
            places = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        else:
            lens = view.lens
            own = pycolmap.Camera(
                model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
            )
            places = np.asarray(own.img_from_cam(local), np.float64).reshape(-1, 2)
            places *= [width / lens.width, height / lens.height]
        with np.errstate(invalid="ignore"):
            inside = ((places >= 0.0) & (places < [width, height])).all(axis=1)
        columns, rows = places[inside].astype(np.intp).T
        counted = self.sure[rows, columns]
        return (
            ahead[inside][counted],
            local[inside, 2][counted],
            self.levels[rows, columns][counted].astype(np.float64),
        )


def without_edges(levels: npt.NDArray[np.float32]) -> Flags:
    """Which pixels [h,w] are distances and differ from those around them by less than EDGE."""
    inner = levels > 0.0
    for axis in (0, 1):
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        before, after = levels[tuple(first)], levels[tuple(second)]
        far = np.abs(before - after) > EDGE * np.minimum(before, after)
        far &= (before > 0.0) & (after > 0.0)
        inner[tuple(first)] &= ~far
        inner[tuple(second)] &= ~far
    return inner


def highest(levels: npt.NDArray[np.uint8], most: int, few: bool) -> Flags:
    """Which pixels [h,w] of a map of confidence are of the highest, which is above 0.

    most: the highest level of all maps of the capture.
    few: whether these have three levels or fewer, as those of phones have; otherwise the upper half counts.
    """
    flags: Flags = (levels > 0) & (levels >= (most if few else 0.5 * most))
    return flags

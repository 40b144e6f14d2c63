"""Photos as coarse grids of cells, and which of the cells show a point of the reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.scene import Camera, Scene
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pixels = npt.NDArray[np.uint8]

CELLS = 48
"""Number of cells along a photo's longer side: about as many as SfM has points across a well-covered photo."""


@dataclass(frozen=True)
class Cells:
    """One photo as a coarse grid of h x w cells.

    camera: the photo's camera for an image of h x w pixels.
    color: mean colour of each cell, uint8 [h, w, 3].
    covered: a known point lies in the cell or in one beside it, bool [h, w].
    used: the mask keeps most of the cell's pixels, bool [h, w].
    points: the known points that the photo shows [k, 3]: column and row in cells, and depth in units of the world.
    """

    camera: Camera
    color: Pixels
    covered: Flags
    used: Flags
    points: Float

    @staticmethod
    def of(view: TrainingView, points: Float) -> Cells:
        """The cells of a photo that shows `points` [k, 3], which lie in the same world as its camera."""
        target = view.full
        factor = min(1.0, CELLS / max(target.camera.width, target.camera.height))
        width = max(1, round(target.camera.width * factor))
        height = max(1, round(target.camera.height * factor))
        camera = target.camera.scaled_to(width, height)

        def area(planes: torch.Tensor) -> npt.NDArray[np.float32]:  # [C, H, W] float to [C, h, w]
            small = torch.nn.functional.interpolate(planes[None], size=(height, width), mode="area")[0]
            array: npt.NDArray[np.float32] = small.numpy()
            return array

        rgb = target.rgb.permute(2, 0, 1).float()
        used = np.ones((height, width), bool)
        mean: npt.NDArray[np.floating] = area(rgb)
        if target.mask is not None:
            # Masked pixels do not count in the mean colour of a cell.
            counted = target.mask[None].float()
            share = area(counted)
            mean = area(rgb * counted) / np.maximum(share, np.float32(1e-6))
            used = share[0] > 0.5
        color = (mean + 0.5).astype(np.uint8).transpose(1, 2, 0)
        places = projected(camera, points)
        return Cells(camera, color, cells_near(places, (height, width), spread=1), used, places)

    def unproject(self, cells: Index, depth: Float) -> Float:
        """Points [k, 3] in the world at the centres of `cells` [k, 2] (row, column) and camera depths `depth` [k]."""
        return self.camera.unproject(cells[:, 1] + 0.5, cells[:, 0] + 0.5, depth)


def cells_of(scene: Scene, views: Sequence[TrainingView]) -> list[Cells]:
    """The cells of every view, in the world of `scene`. Without tracks, every point counts in every view."""
    return [Cells.of(view, points) for view, points in zip(views, visible_points(scene, views), strict=True)]


def visible_points(scene: Scene, views: Sequence[TrainingView]) -> list[Float]:
    """The points [k, 3] that each view shows by the tracks of the reconstruction; all points where it has none."""
    if scene.point_views is None:
        return [scene.points for _ in views]
    tracks = scene.point_views
    point = np.repeat(np.arange(len(scene.points)), np.diff(tracks.offsets))
    order = np.argsort(tracks.views, kind="stable")
    ends = np.cumsum(np.bincount(tracks.views, minlength=len(scene.views)))
    of_view = np.split(point[order], ends[:-1])
    number = {view.name: i for i, view in enumerate(scene.views)}
    return [scene.points[of_view[number[view.name]]] for view in views]


def projected(camera: Camera, points: Float) -> Float:
    """Column, row and depth [k, 3] of those `points` [n, 3] that fall into the picture of `camera`."""
    projection = camera.project(points)
    inside: Float = np.stack([projection.columns, projection.rows, projection.depths], axis=1)[
        projection.inside
    ]
    return inside


def cells_near(places: Float, shape: tuple[int, int], *, spread: int) -> Flags:
    """bool [h, w]: cells that hold a point of `places` (column, row, ...), or have one at most `spread` cells away."""
    height, width = shape
    marks = np.zeros((height + 2 * spread, width + 2 * spread), bool)
    column, row = places[:, 0].astype(np.int64), places[:, 1].astype(np.int64)
    for down in range(2 * spread + 1):
        for right in range(2 * spread + 1):
            marks[row + down, column + right] = True
    return marks[spread : spread + height, spread : spread + width]

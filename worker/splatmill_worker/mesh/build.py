"""A mesh of a model: views, the depths that they agree on, the surface through these, fewer triangles, colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill.schema import Progress
from splatmill_worker.kernels import ops
from splatmill_worker.mesh.colors import colored
from splatmill_worker.mesh.depths import View, confirmed, views_of
from splatmill_worker.mesh.poisson import levels, reconstruct, side_of
from splatmill_worker.mesh.samples import Corners, Region, samples_of
from splatmill_worker.mesh.texture import textured
from splatmill_worker.mesh.triangles import Mesh, simplified, without_specks
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians

Told = Callable[[Progress], None]
"""Hears of every view and stage of a mesh, and may raise to stop."""

MOST_VIEWS = 200
"""Cameras that are used; of more, an even choice."""

MOST_PIXELS = 120_000_000
"""Pixels of all views together, at seven bytes each; with more, all views are smaller."""

FOOTPRINT = 1.0
"""Side of a voxel in widths of a pixel at the median depth."""

LEAST = 100
"""Points of which a surface is made."""

SKIRT = 0.02
"""How far around a box points still count, in sizes of the box, so that the surface does not end before its sides."""

REACH = 2.0
"""Depth up to which surfaces are built, in median depths of all views."""

SPECK = 0.01
"""Share of the largest piece's area below which a piece is left out."""


class NoSurface(Exception):
    """No two views of the model agree on a surface."""


@dataclass(frozen=True)
class MeshSettings:
    """What mesh is asked for.

    faces: most triangles.
    voxel: largest side of the octree's finest cells, world units; None: FOOTPRINT, or what DEEPEST levels reach.
    box: lower and upper corner of the part of the world that is built; None: all of it within REACH.
    texture: longest side of a texture in pixels; None: the vertices have colours.
    """

    faces: int
    voxel: float | None = None
    box: Corners | None = None
    texture: int | None = None


@dataclass(frozen=True)
class Built:
    """A mesh, and what it was made from.

    mesh: with colours.
    views: number of cameras.
    middle: median depth of all views, world units.
    voxel: side of the octree's finest cells, world units.
    extracted: number of triangles before they were made fewer.
    """

    mesh: Mesh
    views: int
    middle: float
    voxel: float
    extracted: int


def build(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    settings: MeshSettings,
    *,
    antialias: bool = False,
    backend: ops.Backend | None = None,
    told: Told = lambda progress: None,
    views: list[View] | None = None,
) -> Built:
    """The mesh of `gaussians` as `cameras` see them.

    views: receives the views with confirmed depths; where it has some already, those are used.

    Raises NoSurface, and poisson.TooFine.
    """
    views = [] if views is None else views
    if not views:
        cameras = chosen(cameras)
        every = views_of(
            gaussians,
            cameras,
            antialias=antialias,
            backend=backend,
            told=lambda done: told(Progress(stage="rendering depths", done=done, total=len(cameras))),
        )
        told(Progress(stage="comparing the depths of neighbouring views"))
        views += confirmed(every)
    depths = torch.cat([view.depth[view.depth > 0] for view in views])
    if not len(depths):
        raise NoSurface
    middle = float(depths.median())
    voxel = settings.voxel or FOOTPRINT * middle / _focal(views)
    samples = samples_of(views, Region(REACH * middle, _around(settings.box)))
    if len(samples.points) < LEAST:
        raise NoSurface
    depth = levels(samples, voxel, exact=settings.voxel is not None)
    told(Progress(stage="laying a surface through the depths"))
    whole = without_specks(_within(reconstruct(samples, depth), settings.box), SPECK)
    if not len(whole.faces):
        raise NoSurface
    told(Progress(stage="simplifying the surface"))
    mesh = simplified(whole, settings.faces)
    told(Progress(stage="colouring the surface"))
    mesh = colored(mesh, views)
    if settings.texture is not None:
        told(Progress(stage="painting a texture"))
        mesh = textured(mesh, views, settings.texture)
    return Built(mesh, len(views), middle, side_of(samples, depth), len(whole.faces))


def chosen(cameras: Sequence[Camera]) -> list[Camera]:
    """At most MOST_VIEWS of the cameras, of a size at which they have MOST_PIXELS at most."""
    step = len(cameras) / min(len(cameras), MOST_VIEWS)
    some = [cameras[int(index * step)] for index in range(min(len(cameras), MOST_VIEWS))]
    pixels = sum(camera.width * camera.height for camera in some)
    factor = min(1.0, math.sqrt(MOST_PIXELS / pixels))
    return [
        camera.scaled_to(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
        for camera in some
    ]


def _within(mesh: Mesh, box: Corners | None) -> Mesh:
    """The faces of a mesh whose vertices all lie in the box."""
    if box is None:
        return mesh
    inside: npt.NDArray[np.bool_] = np.all((mesh.vertices >= box[0]) & (mesh.vertices <= box[1]), axis=1)
    return mesh.only(np.asarray(inside[mesh.faces].all(axis=1)))


def _around(box: Corners | None) -> Corners | None:
    """The box with its SKIRT."""
    if box is None:
        return None
    low, high = np.array(box[0]), np.array(box[1])
    skirt = SKIRT * float((high - low).max())
    return tuple(low - skirt), tuple(high + skirt)


def _focal(views: Sequence[View]) -> float:
    """Median focal length of the views, pixels."""
    return float(torch.tensor([view.camera.fx for view in views]).median())

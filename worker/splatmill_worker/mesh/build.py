"""A mesh of a model: views, the depths that they agree on, the field, its surface, fewer triangles, colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.mesh.colors import colored
from splatmill_worker.mesh.depths import View, confirmed, views_of
from splatmill_worker.mesh.fusion import Corners, Region, fuse
from splatmill_worker.mesh.surface_nets import extract
from splatmill_worker.mesh.triangles import Mesh, simplified, without_specks
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians

MOST_VIEWS = 200
"""Cameras that are used; of more, an even choice."""

MOST_PIXELS = 120_000_000
"""Pixels of all views together, at seven bytes each; with more, all views are smaller."""

FOOTPRINT = 1.0
"""Side of a voxel in widths of a pixel at the median depth."""

REACH = 2.0
"""Depth up to which surfaces are built, in median depths of all views."""

SPECK = 0.01
"""Share of the largest piece's area below which a piece is left out."""


class NoSurface(Exception):
    """No two views of the model agree on a surface."""


@dataclass(frozen=True)
class Wanted:
    """What mesh is asked for.

    faces: most triangles.
    voxel: side of a voxel, world units; None: FOOTPRINT, or larger where the field would grow too large.
    box: lower and upper corner of the part of the world that is built; None: all of it within REACH.
    """

    faces: int
    voxel: float | None = None
    box: Corners | None = None


@dataclass(frozen=True)
class Built:
    """A mesh, and what it was made from.

    mesh: with colours.
    views: number of cameras.
    middle: median depth of all views, world units.
    voxel: side of a voxel, world units.
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
    wanted: Wanted,
    *,
    antialias: bool = False,
    backend: ops.Backend | None = None,
    told: Callable[[str], None] = lambda stage: None,
    views: list[View] | None = None,
) -> Built:
    """The mesh of `gaussians` as `cameras` see them.

    told: hears of every view and stage, and may raise to stop.
    views: receives the views with confirmed depths; where it has some already, those are used.

    Raises NoSurface, and fusion.TooLarge.
    """
    views = [] if views is None else views
    if not views:
        cameras = chosen(cameras)
        every = views_of(
            gaussians,
            cameras,
            antialias=antialias,
            backend=backend,
            told=lambda done: told(f"depth of view {done} of {len(cameras)}"),
        )
        told("comparing the depths of neighbouring views")
        views += confirmed(every)
    depths = torch.cat([view.depth[view.depth > 0] for view in views])
    if not len(depths):
        raise NoSurface
    middle = float(depths.median())
    told("fusing the depths")
    voxel = wanted.voxel or FOOTPRINT * middle / _focal(views)
    field = fuse(views, voxel, Region(REACH * middle, wanted.box), exact=wanted.voxel is not None)
    if not len(field.blocks):
        raise NoSurface
    told("extracting the surface")
    whole = without_specks(_within(extract(field), wanted.box), SPECK)
    if not len(whole.faces):
        raise NoSurface
    told("simplifying the surface")
    mesh = simplified(whole, wanted.faces)
    told("colouring the surface")
    return Built(colored(mesh, views), len(views), middle, field.voxel, len(whole.faces))


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
    """The faces of a mesh whose vertices all lie in the box: its blocks reach beyond."""
    if box is None:
        return mesh
    inside: npt.NDArray[np.bool_] = np.all((mesh.vertices >= box[0]) & (mesh.vertices <= box[1]), axis=1)
    return mesh.only(np.asarray(inside[mesh.faces].all(axis=1)))


def _focal(views: Sequence[View]) -> float:
    """Median focal length of the views, pixels."""
    return float(torch.tensor([view.camera.fx for view in views]).median())

"""The solids of the town: hulls (convex, with flat faces) and balls (ellipsoids), met by all rays of a photo at once.

A photo's rays are its eye + depth * direction, and the direction is an affine function of the pixel. So the inverse
depth at which a ray meets a plane is affine in the pixel as well: a plane costs an addition and a comparison per ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.scene import Camera

Tensor = torch.Tensor
Float = npt.NDArray[np.float64]

START = 0.02
"""Metres from a surface at which a ray towards the sun begins, so that rounding does not let it meet that surface."""


@dataclass(frozen=True)
class Rays:
    """The rays of a grid of samples over a photo.

    eye: where they begin, float64 [3].
    rotation: of the camera, from the world, float64 [3, 3].
    x, y: normalised image coordinates of the columns [W] and the rows [H], float32.
    """

    eye: Float
    rotation: Float
    x: Tensor
    y: Tensor

    @classmethod
    def of(cls, camera: Camera, samples: int) -> Rays:
        """samples x samples rays per pixel, evenly spaced."""
        columns = (torch.arange(camera.width * samples, dtype=torch.float64) + 0.5) / samples
        rows = (torch.arange(camera.height * samples, dtype=torch.float64) + 0.5) / samples
        x, y = camera.normalized(columns, rows)
        return cls(camera.center, camera.viewmat[:3, :3], x.float(), y.float())

    def part(self, rows: slice, columns: slice) -> Rays:
        return Rays(self.eye, self.rotation, self.x[columns], self.y[rows])

    def along(self, normal: Float, factor: float = 1.0) -> Tensor:
        """`factor` times the products [H, W] of all directions and `normal` [3]."""
        a, b, c = (self.rotation @ normal * factor).tolist()
        return torch.add((a * self.x)[None, :], (b * self.y + c)[:, None])


@dataclass(frozen=True)
class Face:
    """What a surface looks like: the number of its texture, from `offset` in metres on, and the factor of its colours.

    u, v: directions of the texture's columns and rows [3] in the world.
    """

    texture: int
    u: tuple[float, float, float]
    v: tuple[float, float, float]
    offset: tuple[float, float]
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Hull:
    """A convex solid: the points with normals @ point <= limits.

    normals: outward unit vectors [P, 3]. limits: [P], in metres. faces: of each plane.
    lowest, highest: corners of a box around it, in metres.
    """

    normals: Float
    limits: Float
    faces: tuple[Face, ...]
    lowest: tuple[float, float, float]
    highest: tuple[float, float, float]

    def hit(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Inverse depth [H, W] where rays enter, 0 where they pass by, and the plane [H, W] by which they do."""
        gaps = self.limits - self.normals @ rays.eye
        enter, leave, plane = None, torch.zeros(len(rays.y), len(rays.x)), None
        for number, (normal, gap) in enumerate(zip(self.normals, gaps.tolist(), strict=True)):
            if gap == 0.0:
                gap = -1e-9
            inverse = rays.along(normal, 1.0 / gap)
            if gap > 0.0:
                torch.maximum(leave, inverse, out=leave)
            elif enter is None:
                enter, plane = inverse, torch.full(inverse.shape, number, dtype=torch.int32)
            else:
                assert plane is not None
                plane.masked_fill_(inverse < enter, number)
                torch.minimum(enter, inverse, out=enter)
        if enter is None or plane is None:
            raise ValueError("The camera stands inside of a solid: fly higher than all of them.")
        return torch.where(enter > leave, enter, 0.0), plane

    def shades(self, rays: Rays, depth: Tensor, sun: Float) -> Tensor:
        """Whether the solid stands between the points at `depth` [H, W] and the sun, bool [H, W]."""
        gaps = self.limits - self.normals @ rays.eye
        near, far = torch.full(depth.shape, START), torch.full(depth.shape, torch.inf)
        for normal, gap in zip(self.normals, gaps.tolist(), strict=True):
            towards = float(normal @ sun)
            if abs(towards) < 1e-9:
                far = torch.where(gap - rays.along(normal) * depth < 0.0, 0.0, far)
                continue
            reach = torch.addcmul(torch.tensor(gap / towards), rays.along(normal, -1.0 / towards), depth)
            if towards > 0.0:
                torch.minimum(far, reach, out=far)
            else:
                torch.maximum(near, reach, out=near)
        return near < far

    @property
    def shapes(self) -> list[list[float]]:
        """Rows of LOOKS that say how each face is turned: its normal, a point, and no curvature."""
        return [[*normal, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0] for normal in self.normals.tolist()]


@dataclass(frozen=True)
class Ball:
    """An ellipsoid with upright axis; `radii` along x, y and z."""

    center: tuple[float, float, float]
    radii: tuple[float, float, float]
    face: Face

    @property
    def faces(self) -> tuple[Face, ...]:
        return (self.face,)

    @property
    def lowest(self) -> tuple[float, float, float]:
        x, y, z = (np.array(self.center) - self.radii).tolist()
        return x, y, z

    @property
    def highest(self) -> tuple[float, float, float]:
        x, y, z = (np.array(self.center) + self.radii).tolist()
        return x, y, z

    def _directions(self, rays: Rays) -> list[Tensor]:
        """Directions [H, W] along each axis, where the ball is one of radius 1."""
        return [rays.along(axis, 1.0 / r) for axis, r in zip(np.eye(3), self.radii, strict=True)]

    def hit(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Inverse depth [H, W] where rays enter, 0 where they pass by; and zeros, as there is one face."""
        eye = (rays.eye - self.center) / self.radii
        x, y, z = self._directions(rays)
        outside = float(eye @ eye) - 1.0
        if outside <= 0.0:
            raise ValueError("The camera stands inside of a solid: fly higher than all of them.")
        b = x * eye[0] + y * eye[1] + z * eye[2]
        root = b * b - (x * x + y * y + z * z) * outside
        inverse = (root.clamp(min=0).sqrt() - b) / outside
        hit = torch.where((root > 0) & (b < 0), inverse, 0.0)
        return hit, torch.zeros(hit.shape, dtype=torch.int32)

    def shades(self, rays: Rays, depth: Tensor, sun: Float) -> Tensor:
        """Whether the ball stands between the points at `depth` [H, W] and the sun, bool [H, W]."""
        eye = (rays.eye - self.center) / self.radii
        towards = sun / self.radii
        points = [e + d * depth for e, d in zip(eye.tolist(), self._directions(rays), strict=True)]
        a = float(towards @ towards)
        b = sum(p * t for p, t in zip(points, towards.tolist(), strict=True))
        c = sum(p * p for p in points) - 1.0
        assert isinstance(b, Tensor)
        assert isinstance(c, Tensor)
        root = b * b - a * c
        return (root > 0) & (root.clamp(min=0).sqrt() - b > a * START)

    @property
    def shapes(self) -> list[list[float]]:
        """The row of LOOKS that says how it is turned: normals grow from its centre."""
        return [[0.0, 0.0, 0.0, *self.center, *(1.0 / r**2 for r in self.radii)]]


Solid = Hull | Ball

FACES = 8
"""Faces that a solid has at most."""

LOOKS = {"normal": 3, "center": 3, "curvature": 3, "u": 3, "v": 3, "offset": 2, "tint": 3}
"""Columns of the table of faces. The normal at a point is normal + curvature * (point - center), of any length."""


def looks(solids: Sequence[Solid]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """The table [n, FACES, columns] of the faces of n solids, and the numbers [n, FACES] of their textures."""
    table = np.zeros((len(solids), FACES, sum(LOOKS.values())), np.float32)
    textures = np.zeros((len(solids), FACES), np.int64)
    for number, solid in enumerate(solids):
        for k, (shape, face) in enumerate(zip(solid.shapes, solid.faces, strict=True)):
            table[number, k] = [*shape, *face.u, *face.v, *face.offset, *face.tint]
            textures[number, k] = face.texture
    return table, textures

"""Photographs the town: colours by several rays per pixel, and exact depths at pixel centres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ground.paint import BLOCK
from splatmill_worker.synthetic.ground.solids import FACES, LOOKS, Rays, Solid
from splatmill_worker.synthetic.ground.town import HIGHEST, Town

Tensor = torch.Tensor
Float = npt.NDArray[np.float64]

SUN = np.array([0.48, 0.36, 0.80]) / math.sqrt(0.48**2 + 0.36**2 + 0.80**2)
"""Direction to the sun: in the north-east, 53 degrees high."""

SUNLIGHT, SKYLIGHT = (0.92, 0.87, 0.78), (0.38, 0.42, 0.50)
"""What the sun and the sky add to a surface's colour, of that colour: the sky by how far the surface faces upwards."""

Place = tuple[slice, slice]
"""Rows and columns of rays."""


@dataclass(frozen=True)
class _PlacedSolid:
    """A solid that may be in view, with the rays that may meet it and those whose points it may shade.

    looks, textures: of its faces, as `solids.looks` returns them.
    """

    solid: Solid
    place: Place | None
    shadow: Place | None
    looks: npt.NDArray[np.float32]
    textures: npt.NDArray[np.int64]


def photograph(town: Town, camera: Camera, samples: int = 2) -> npt.NDArray[np.uint8]:
    """The colours that the camera sees, uint8 [H, W, 3].

    samples: rays per pixel along each axis, whose mean is the pixel. Where all of them meet the same face, its texture
    is sampled once, at the pixel's centre. Raises ValueError for a camera that is not above the town's HIGHEST, or that
    sees the horizon.
    """
    rays = Rays.of(camera, samples)
    solids = list(_solids(town, camera, rays))
    inverse, face = _cast(rays, solids)
    light = _light(rays, solids, 1.0 / inverse)
    faces = _Faces.of(solids)
    whole, parts = (
        _Samples.of(camera, rays, samples, inverse, face, light, uniform) for uniform in (True, False)
    )
    color = torch.zeros(camera.height * camera.width, 3)
    color[whole.pixel] = _shaded(town, faces, rays, whole)
    color.index_add_(0, parts.pixel, _shaded(town, faces, rays, parts), alpha=1.0 / samples**2)
    rgb = (color.clamp(0, 255) + 0.5).clamp(max=255).to(torch.uint8)
    shot: npt.NDArray[np.uint8] = rgb.reshape(camera.height, camera.width, 3).numpy()
    return shot


def depths(town: Town, camera: Camera) -> npt.NDArray[np.float32]:
    """Depth at pixel centres, float32 [H, W], in metres. Raises ValueError as `photograph`."""
    rays = Rays.of(camera, 1)
    inverse, _ = _cast(rays, list(_solids(town, camera, rays)))
    depth: npt.NDArray[np.float32] = (1.0 / inverse).numpy()
    return depth


def _cast(rays: Rays, solids: list[_PlacedSolid]) -> tuple[Tensor, Tensor]:
    """Inverse depth, and which face of which solid the rays meet: FACES times its number + the face, or -1 [H, W]."""
    inverse = _on_ground(rays)
    face = torch.full(inverse.shape, -1, dtype=torch.int32)
    for number, each in enumerate(solids):
        if each.place is None:
            continue
        entry, plane = each.solid.hit(rays.part(*each.place))
        nearest, here = inverse[each.place], face[each.place]
        torch.where(entry > nearest, plane + number * FACES, here, out=here)
        torch.maximum(entry, nearest, out=nearest)
    return inverse, face


def _on_ground(rays: Rays) -> Tensor:
    """Inverse depth [H, W] of the ground, which is at height 0."""
    if not rays.eye[2] > HIGHEST:
        raise ValueError(f"The camera is {rays.eye[2]:.1f} m high: it must be above {HIGHEST:.0f} m.")
    inverse = rays.along(np.array([0.0, 0.0, 1.0]), -1.0 / float(rays.eye[2]))
    if not bool((inverse > 0).all()):
        raise ValueError("The camera sees the horizon: tilt it further down.")
    return inverse


def _solids(town: Town, camera: Camera, rays: Rays) -> Iterator[_PlacedSolid]:
    """The solids that a photo shows or whose shadows it may show."""
    for east, north in _blocks(camera):
        block = town.block(east, north)
        if not block.solids:
            continue
        corners = block.corners
        ahead = [_places(camera, rays, corners)]
        # The shadow of a solid lies within its corners and their shadows on the ground.
        fallen = corners - corners[..., 2:] / SUN[2] * SUN
        both = np.concatenate([corners, fallen], axis=1)
        ahead.append(_places(camera, rays, both))
        for solid, place, shadow, look, number in zip(
            block.solids, *ahead, block.looks, block.textures, strict=True
        ):
            if shadow is not None:
                yield _PlacedSolid(solid, place, shadow, look, number)


def _blocks(camera: Camera) -> list[tuple[int, int]]:
    """Numbers of the blocks that hold what is in view, or what shades it."""
    columns, rows = np.array([0.0, 1, 0, 1]) * camera.width, np.array([0.0, 0, 1, 1]) * camera.height
    x, y = camera.normalized(columns, rows)
    rays = np.stack([x, y, np.ones(4)], axis=1) @ camera.viewmat[:3, :3]
    if not (rays[:, 2] < 0).all():
        raise ValueError("The camera sees the horizon: tilt it further down.")
    ground = camera.center - rays / rays[:, 2:] * camera.center[2]
    places = np.concatenate([ground[:, :2], camera.center[None, :2]])
    reach = HIGHEST / SUN[2] * math.hypot(*SUN[:2])
    low = np.floor((places.min(0) - reach) / BLOCK).astype(int)
    high = np.floor((places.max(0) + reach) / BLOCK).astype(int)
    return [(e, n) for e in range(low[0], high[0] + 1) for n in range(low[1], high[1] + 1)]


def _places(camera: Camera, rays: Rays, corners: Float) -> list[Place | None]:
    """The rectangle of rays around the projections of each solid's corners [n, k, 3]; None where none is inside."""
    local = camera.to_camera(corners.reshape(-1, 3)).reshape(corners.shape)
    depth = local[..., 2]
    behind = (depth < 0.1).any(1)
    safe = np.maximum(depth, 0.1)
    places: list[Place | None] = []
    scale = len(rays.x) / camera.width
    bounds = []
    for axis, focal, middle, size in (
        (1, camera.fy, camera.cy, camera.height),
        (0, camera.fx, camera.cx, camera.width),
    ):
        positions = (local[..., axis] / safe * focal + middle) * scale
        low = np.clip(np.floor(positions.min(1)) - 1, 0, size * scale).astype(int)
        high = np.clip(np.ceil(positions.max(1)) + 1, 0, size * scale).astype(int)
        bounds.append((np.where(behind, 0, low), np.where(behind, round(size * scale), high)))
    for top, bottom, left, right in zip(*bounds[0], *bounds[1], strict=True):
        empty = bottom <= top or right <= left
        places.append(None if empty else (slice(int(top), int(bottom)), slice(int(left), int(right))))
    return places


def _light(rays: Rays, solids: list[_PlacedSolid], depth: Tensor) -> Tensor:
    """Whether the sun reaches the points at `depth` [H, W], bool."""
    light = torch.ones(depth.shape, dtype=torch.bool)
    for each in solids:
        if each.shadow is not None:
            light[each.shadow] &= ~each.solid.shades(rays.part(*each.shadow), depth[each.shadow], SUN)
    return light


@dataclass(frozen=True)
class _Faces:
    """The faces of all solids in view, as `_cast` numbers them: their columns LOOKS, and the texture of each [n]."""

    columns: dict[str, Tensor]
    textures: Tensor

    @classmethod
    def of(cls, solids: list[_PlacedSolid]) -> _Faces:
        width = sum(LOOKS.values())
        table = torch.from_numpy(
            np.concatenate([np.zeros((0, FACES, width), np.float32), *(s.looks[None] for s in solids)])
        )
        textures = np.concatenate([np.zeros((0, FACES), np.int64), *(s.textures[None] for s in solids)])
        parts = torch.split_with_sizes(table.reshape(-1, width), list(LOOKS.values()), 1)
        columns = dict(zip(LOOKS, parts, strict=True))
        return cls(columns, torch.from_numpy(textures.reshape(-1)))

    def at(self, face: Tensor, name: str) -> Tensor:
        """The columns of that name [N, k], for each of these faces [N]."""
        return self.columns[name][face]


@dataclass(frozen=True)
class _Samples:
    """Points that are shaded.

    pixel: number of the photo's pixel [N]. x, y: normalised image coordinates [N]. depth: [N], in metres.
    face: as `_cast` numbers them [N]. light: share of the point that is in the sun [N], 0 to 1. apart: distance of
    neighbouring samples of an image at depth 1.
    """

    pixel: Tensor
    x: Tensor
    y: Tensor
    depth: Tensor
    face: Tensor
    light: Tensor
    apart: float

    @classmethod
    def of(
        cls,
        camera: Camera,
        rays: Rays,
        samples: int,
        inverse: Tensor,
        face: Tensor,
        light: Tensor,
        uniform: bool,
    ) -> _Samples:
        """The centres of pixels whose rays all meet the same face, or all rays of the others."""
        height, width = camera.height, camera.width
        split = face.view(height, samples, width, samples)
        same = (split == split[:, :1, :, :1]).all(3).all(1)
        if uniform:
            pixel = same.view(-1).nonzero()[:, 0]
            # The inverse depth of a flat face is affine in the pixel: the mean is that of the centre.
            mean, lit = (
                part.view(height, samples, width, samples).mean((1, 3)).view(-1)[pixel]
                for part in (inverse, light.float())
            )
            x, y = (axis.view(-1, samples).mean(1) for axis in (rays.x, rays.y))
            at, kind, step = (pixel // width, pixel % width), split[:, 0, :, 0].reshape(-1)[pixel], samples
        else:
            apart = ~same[:, None, :, None].expand(-1, samples, -1, samples).reshape(face.shape)
            row, column = apart.nonzero(as_tuple=True)
            at = (row, column)
            mean, lit, kind, step = inverse[at], light[at].float(), face[at], 1
            x, y, pixel = rays.x, rays.y, at[0] // samples * width + at[1] // samples
        apart_ = step * float(rays.x[1] - rays.x[0])
        return cls(pixel, x[at[1]], y[at[0]], 1.0 / mean, kind.long(), lit, apart_)


def _shaded(town: Town, faces: _Faces, rays: Rays, at: _Samples) -> Tensor:
    """Colours [N, 3], 0 to 255."""
    color = torch.empty(len(at.depth), 3)
    if len(color) == 0:
        return color
    parts = [
        (a * at.x + b * at.y + c) * at.depth + eye
        for (a, b, c), eye in zip(rays.rotation.T.tolist(), rays.eye.tolist(), strict=True)
    ]
    points = torch.stack(parts, dim=1)
    footprint = at.apart * float(at.depth.mean())
    bare = (at.face < 0).nonzero()[:, 0]
    lit = _lit(torch.tensor([[0.0, 0.0, 1.0]]), at.light[bare])
    color[bare] = _ground(town, points[bare], footprint) * lit
    built = (at.face >= 0).nonzero()[:, 0]
    order = built[faces.textures[at.face[built]].argsort(stable=True)]
    points, face = points[order], at.face[order]
    normals = faces.at(face, "normal") + (points - faces.at(face, "center")) * faces.at(face, "curvature")
    tint = faces.at(face, "tint") * _lit(torch.nn.functional.normalize(normals, dim=1), at.light[order])
    offset = faces.at(face, "offset")
    u, v = ((points * faces.at(face, name)).sum(1) + offset[:, k] for k, name in enumerate("uv"))
    numbers, counts = torch.unique_consecutive(faces.textures[face], return_counts=True)
    start, texels = 0, torch.empty_like(points)
    for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
        run = slice(start, start + count)
        start += count
        texels[run] = town.textures[number].sample(u[run], v[run], footprint)
    color[order] = texels * tint
    return color


def _lit(normals: Tensor, light: Tensor) -> Tensor:
    """Factor [N, 3] of the colours of points with these normals [N or 1, 3], of which `light` [N] is in the sun."""
    sun = (normals @ torch.from_numpy(SUN).float()).clamp(min=0) * light
    sky = 0.5 + 0.5 * normals[:, 2]
    return sun[:, None] * torch.tensor(SUNLIGHT) + sky[:, None] * torch.tensor(SKYLIGHT)


def _ground(town: Town, points: Tensor, footprint: float) -> Tensor:
    """Colours [N, 3] of the ground at points [N, 3]."""
    color = torch.empty_like(points)
    x, y = points[:, 0], points[:, 1]
    east, north = (x / BLOCK).floor().to(torch.int32), (y / BLOCK).floor().to(torch.int32)
    for e in range(int(east.min()), int(east.max()) + 1):
        for n in range(int(north.min()), int(north.max()) + 1):
            chosen = ((east == e) & (north == n)).nonzero()[:, 0]
            if len(chosen):
                texture = town.ground(e, n)
                color[chosen] = texture.sample(x[chosen] - e * BLOCK, y[chosen] - n * BLOCK, footprint)
    return color

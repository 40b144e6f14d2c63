"""A small ray caster that renders photos of a textured still life, with exact cameras and depths.

Intersections with all surfaces (discs, boxes, spheres, cylinders, a dome) are analytic. Only colour is sampled: with a
box filter of samples x samples rays per pixel, and mip-mapped textures. In the world z points up, and a unit is about
half the width of the table; cameras have OpenCV axes (x right, y down, z forward).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.synthetic.textures import MipMap, painted, planks, sky

Tensor = torch.Tensor

_FAR = 1e9
"""Distance along a ray that hits nothing, in world units."""

_NEAR = 1e-4
"""Distance along a ray, in world units, up to which an intersection counts as its origin."""

_LIGHT = np.array([0.45, -0.35, 0.82])
"""Direction to the sun, of any length."""

_AMBIENT = 0.42
"""Share of a surface's colour that is seen in shadow."""

_MARGIN = 1e-3
"""What is added to the reach of a solid, in world units, and to the angles of a tile, for what rounding leaves."""

_DOME_RADIUS = 40.0
"""World units, around the origin."""

_TILE = 128
"""Pixels along each side of a tile, whose rays are cast at a time: their intermediate results stay in the cache, and
most solids are met by none of them."""


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot products along the last axis, of three. A sum along so short an axis takes several times as long."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _from(origin: Tensor, center: tuple[float, float, float]) -> list[Tensor]:
    """The coordinates of `origin` [..., 3], counted from `center`."""
    return [origin[..., axis] - center[axis] for axis in range(3)]


@dataclass(frozen=True)
class Disc:
    """A horizontal disc at height `z`; `scale`: widths of the texture per world unit."""

    z: float
    radius: float
    texture: MipMap
    scale: float

    def hit(self, origin: Tensor, rays: Tensor) -> Tensor:
        t = (self.z - origin[..., 2]) / rays[..., 2]
        x = origin[..., 0] + t * rays[..., 0]
        y = origin[..., 1] + t * rays[..., 1]
        return torch.where((t > _NEAR) & (x * x + y * y < self.radius**2), t, _FAR)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        normal = torch.zeros_like(points)
        normal[:, 2] = 1.0
        return points[:, :2] * self.scale, normal


@dataclass(frozen=True)
class Box:
    """A box turned by `turn` radians about z; each face shows another part of the texture.

    half: half its extents. shine: strength of its highlight.
    """

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float
    texture: MipMap
    scale: float
    shine: float = 0.0

    @property
    def reach(self) -> float:
        return math.hypot(*self.half)

    def _turned(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        c, s = math.cos(self.turn), math.sin(self.turn)
        return c * x + s * y, c * y - s * x, z

    def hit(self, origin: Tensor, rays: Tensor) -> Tensor:
        places = self._turned(*_from(origin, self.center))
        near, far = torch.tensor(-math.inf), torch.tensor(math.inf)
        for half, place, ray in zip(self.half, places, self._turned(*rays.unbind(-1)), strict=True):
            inverse = 1.0 / ray
            a, b = (-half - place) * inverse, (half - place) * inverse
            near = torch.maximum(near, torch.minimum(a, b))
            far = torch.minimum(far, torch.maximum(a, b))
        return torch.where((near < far) & (near > _NEAR), near, _FAR)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local = torch.stack(self._turned(*_from(points, self.center)), -1)
        unit = local / torch.tensor(self.half)
        axis = unit.abs().argmax(-1)
        sign = torch.sign(unit.gather(-1, axis[:, None]))
        normal = torch.zeros_like(points).scatter_(-1, axis[:, None], sign)
        c, s = math.cos(self.turn), math.sin(self.turn)
        turned = torch.stack(
            [c * normal[:, 0] - s * normal[:, 1], s * normal[:, 0] + c * normal[:, 1], normal[:, 2]], -1
        )
        u = torch.where(axis == 0, local[:, 1], local[:, 0])
        v = torch.where(axis == 2, local[:, 1], local[:, 2])
        face = axis.to(u.dtype) + 3.0 * (sign[:, 0] > 0)
        return torch.stack([u * self.scale + 0.37 * face, v * self.scale + 0.61 * face], -1), turned


@dataclass(frozen=True)
class Sphere:
    """A sphere textured by longitude and latitude; `shine`: strength of its highlight."""

    center: tuple[float, float, float]
    radius: float
    texture: MipMap
    scale: float
    shine: float = 0.0

    @property
    def reach(self) -> float:
        return self.radius

    def hit(self, origin: Tensor, rays: Tensor) -> Tensor:
        o = origin - torch.tensor(self.center)
        b = _dot(o, rays)
        disc = b * b - (_dot(o, o) - self.radius**2)
        t = -b - disc.clamp(min=0).sqrt()
        return torch.where((disc > 0) & (t > _NEAR), t, _FAR)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        normal = (points - torch.tensor(self.center)) / self.radius
        u = torch.atan2(normal[:, 1], normal[:, 0]) / (2 * math.pi)
        v = torch.asin(normal[:, 2].clamp(-1, 1)) / math.pi
        return torch.stack([u * 2 * self.scale, v * self.scale], -1), normal


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder with a lid; `half_height`: half its height."""

    center: tuple[float, float, float]
    radius: float
    half_height: float
    texture: MipMap
    scale: float
    shine: float = 0.0

    @property
    def reach(self) -> float:
        return math.hypot(self.radius, self.half_height)

    def hit(self, origin: Tensor, rays: Tensor) -> Tensor:
        (x, y, z), (along_x, along_y, along_z) = _from(origin, self.center), rays.unbind(-1)
        a = along_x * along_x + along_y * along_y
        b = x * along_x + y * along_y
        disc = b * b - a * (x * x + y * y - self.radius**2)
        side = (-b - disc.clamp(min=0).sqrt()) / a
        on_side = (disc > 0) & (side > _NEAR) & ((z + side * along_z).abs() < self.half_height)
        lid = (self.half_height - z) / along_z
        on_lid = (lid > _NEAR) & ((x + lid * along_x) ** 2 + (y + lid * along_y) ** 2 < self.radius**2)
        return torch.minimum(torch.where(on_side, side, _FAR), torch.where(on_lid, lid, _FAR))

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local = points - torch.tensor(self.center)
        lid = local[:, 2] > self.half_height - 1e-3
        around = torch.atan2(local[:, 1], local[:, 0]) * self.radius
        normal = torch.where(
            lid[:, None],
            torch.tensor([0.0, 0.0, 1.0]),
            torch.stack([local[:, 0], local[:, 1], torch.zeros_like(local[:, 0])], -1) / self.radius,
        )
        u = torch.where(lid, local[:, 0], around)
        v = torch.where(lid, local[:, 1] + 5.0, local[:, 2])
        return torch.stack([u, v], -1) * self.scale, normal


Solid = Disc | Box | Sphere | Cylinder


@dataclass(frozen=True)
class StillLife:
    """The scene.

    solids: things on a round table, the table and the floor.
    dome: texture of the sky around them.
    light: unit vector to the sun.
    """

    solids: tuple[Solid, ...]
    dome: MipMap
    light: np.ndarray


def still_life(seed: int = 0) -> StillLife:
    """The still life; `seed` decides textures, positions and angles.

    The last one is kept (115 MB), because painting its textures takes as long as a dozen small photos of it.
    """
    return _arranged(seed)


@lru_cache(maxsize=1)
def _arranged(seed: int) -> StillLife:
    """The still life of this seed. The cache would keep the one of a default apart from that of its value."""
    rng = np.random.default_rng(seed)
    solids: list[Solid] = [
        Disc(0.0, 1.9, MipMap(painted(rng, 1024, density=900)), 0.27),
        Disc(-0.9, 11.0, MipMap(planks(rng, 1024)), 0.12),
    ]
    for angle, ring, half in (
        (0.3, 0.75, (0.34, 0.26, 0.42)),
        (2.5, 0.95, (0.28, 0.34, 0.24)),
        (4.4, 1.0, (0.2, 0.2, 0.6)),
    ):
        a = angle + rng.uniform(-0.15, 0.15)
        center = (ring * math.cos(a), ring * math.sin(a), half[2])
        solids.append(
            Box(center, half, float(rng.uniform(0, 3)), MipMap(painted(rng, 512, density=220)), 0.9)
        )
    for angle, ring, radius, shine in ((1.4, 0.85, 0.36, 0.5), (3.4, 0.8, 0.3, 0.0), (5.4, 1.15, 0.26, 0.8)):
        a = angle + rng.uniform(-0.15, 0.15)
        center = (ring * math.cos(a), ring * math.sin(a), radius)
        solids.append(Sphere(center, radius, MipMap(painted(rng, 512, density=160)), 1.0, shine))
    solids.append(Cylinder((0.0, 0.05, 0.55), 0.27, 0.55, MipMap(painted(rng, 512, density=200)), 0.8))
    return StillLife(tuple(solids), MipMap(sky(rng, 2048)), _LIGHT / np.linalg.norm(_LIGHT))


def orbit(count: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """`count` cameras on a rising spiral around the table, with random offsets of position and direction."""
    rng = np.random.default_rng([seed, 7])
    focal = 0.82 * max(width, height)
    cameras = []
    for k in range(count):
        turns = 2 if count >= 24 else 1
        angle = 2 * math.pi * turns * (k + 0.3 * rng.uniform(-0.5, 0.5)) / count
        rise = 0.32 + 0.5 * k / max(count - 1, 1) + rng.uniform(-0.04, 0.04)
        distance = 3.7 + rng.uniform(-0.2, 0.2)
        eye = distance * np.array(
            [math.cos(angle) * math.cos(rise), math.sin(angle) * math.cos(rise), math.sin(rise)]
        )
        target = np.array([0.0, 0.0, 0.25]) + rng.uniform(-0.12, 0.12, 3)
        cameras.append(look_at(eye, target, width, height, focal))
    return cameras


def look_at(eye: np.ndarray, target: np.ndarray, width: int, height: int, focal: float) -> Camera:
    """A level pinhole camera at `eye` [3], directed at `target` [3].

    focal: in pixels. The principal point is the photo's centre.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(width, height, focal, focal, width / 2, height / 2, viewmat_of(rotation, eye))


def photograph(scene: StillLife, camera: Camera, samples: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """The photo that `camera` takes: colour, uint8 [H, W, 3], and depth at pixel centres, float32 [H, W].

    samples: rays per pixel along each axis.
    """
    rgb = np.empty((camera.height, camera.width, 3), np.uint8)
    depth = np.empty((camera.height, camera.width), np.float32)
    for tile in _tiles(camera):
        color, centers = _sampled(scene, camera, tile, samples)
        rgb[tile] = color
        if centers is None:
            centers = _cast(scene, camera, tile, 0.5, 0.5, shade=False)[1]
        depth[tile] = centers.numpy()
    return rgb, depth


def picture(scene: StillLife, camera: Camera, samples: int = 2) -> np.ndarray:
    """The colours that `photograph` returns, uint8 [H, W, 3], without the rays that only measure depth."""
    rgb = np.empty((camera.height, camera.width, 3), np.uint8)
    for tile in _tiles(camera):
        rgb[tile] = _sampled(scene, camera, tile, samples)[0]
    return rgb


Tile = tuple[slice, slice]
"""Rows and columns of a photo."""


def _tiles(camera: Camera) -> list[Tile]:
    """The tiles of a photo."""
    rows, columns = (
        [slice(start, min(start + _TILE, size)) for start in range(0, size, _TILE)]
        for size in (camera.height, camera.width)
    )
    return [(row, column) for row in rows for column in columns]


def _sampled(scene: StillLife, camera: Camera, tile: Tile, samples: int) -> tuple[np.ndarray, Tensor | None]:
    """Colour uint8 [h, w, 3], and depth [h, w] where one of the rays goes through the pixel centres, or None."""
    offsets = [(k + 0.5) / samples for k in range(samples)]
    cast = {(u, v): _cast(scene, camera, tile, u, v) for u in offsets for v in offsets}
    shaded = torch.stack([color for color, _ in cast.values()]).mean(0)
    centers = cast.get((0.5, 0.5))
    color = (shaded.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    return color, None if centers is None else centers[1]


def _cast(
    scene: StillLife, camera: Camera, tile: Tile, du: float, dv: float, shade: bool = True
) -> tuple[Tensor, Tensor]:
    """Colour [h, w, 3] and depth [h, w] along one ray per pixel of a tile, at (column + du, row + dv).

    Without `shade`, no colour is computed.
    """
    rotation = torch.from_numpy(camera.viewmat[:3, :3].astype(np.float32))
    eye = torch.from_numpy(camera.center.astype(np.float32))
    rows, columns = tile
    x, y = camera.normalized(
        torch.arange(columns.start, columns.stop) + du, torch.arange(rows.start, rows.stop) + dv
    )
    shape = (len(y), len(x))
    x, y = x.expand(shape).reshape(-1), y[:, None].expand(shape).reshape(-1)
    length = (x * x + y * y + 1).sqrt()
    # Each coordinate in a row of its own: all rays of one are read at a time.
    rays = torch.stack([(a * x + b * y + c) / length for a, b, c in rotation.T.tolist()]).T

    dome = Sphere((0.0, 0.0, 0.0), _DOME_RADIUS, scene.dome, 1.0)
    b = _dot(eye, rays)
    nearest = -b + (b * b - (eye @ eye - _DOME_RADIUS**2)).sqrt()  # from inside, the far root
    which = torch.full(nearest.shape, -1)
    ends = [0, shape[1] - 1, -shape[1], -1]
    for k, solid in enumerate(scene.solids):
        if not isinstance(solid, Disc) and _passed(solid, eye, rays[ends]):
            continue
        t = solid.hit(eye, rays)
        closer = t < nearest
        nearest = torch.where(closer, t, nearest)
        which = torch.where(closer, k, which)
    depth = (nearest / length).reshape(shape)
    if not shade:
        return torch.empty(0), depth

    points = eye + nearest[:, None] * rays
    color = torch.empty_like(points)
    pixel = nearest / camera.fx  # the width of a pixel's footprint where it lands
    for k in range(-1, len(scene.solids)):
        chosen = (which == k).nonzero()[:, 0]
        if len(chosen) == 0:
            continue
        surface: Solid = dome if k < 0 else scene.solids[k]
        uv, normal = surface.surface(points[chosen])
        if k < 0:
            color[chosen] = surface.texture.sample(uv, torch.zeros(len(chosen)))
            continue
        albedo = surface.texture.sample(uv, pixel[chosen] * surface.scale)
        color[chosen] = _lit(scene, surface, points[chosen], normal, rays[chosen], albedo)
    return color.reshape(*shape, 3), depth


def _passed(solid: Box | Sphere | Cylinder, eye: Tensor, corners: Tensor) -> bool:
    """Whether all rays of a tile, whose corners are these rays [4, 3], pass by the sphere around a solid."""
    middle = [sum(each) for each in zip(*corners.tolist(), strict=True)]
    towards = [a - b for a, b in zip(solid.center, eye.tolist(), strict=True)]
    distance = math.hypot(*towards)
    if distance <= solid.reach:
        return False
    width = max(_angle(middle, corner) for corner in corners.tolist())
    return _angle(middle, towards) > width + math.asin(solid.reach / distance) + _MARGIN


def _angle(a: list[float], b: list[float]) -> float:
    """Between two vectors, in radians."""
    return math.acos(
        max(-1.0, min(1.0, sum(x * y for x, y in zip(a, b, strict=True)) / (math.hypot(*a) * math.hypot(*b))))
    )


def _shades_none(solid: Box | Sphere | Cylinder, lowest: Tensor, highest: Tensor, light: Tensor) -> bool:
    """Whether the sphere around a solid stands between the light and no point of a box with these corners."""
    middle = [(a + b) / 2 for a, b in zip(lowest.tolist(), highest.tolist(), strict=True)]
    towards = [a - b for a, b in zip(solid.center, middle, strict=True)]
    reach = solid.reach + math.dist(lowest.tolist(), highest.tolist()) / 2 + _MARGIN
    ahead = sum(a * b for a, b in zip(towards, light.tolist(), strict=True))
    return bool(ahead < -reach or math.hypot(*towards) ** 2 - ahead**2 > reach**2)


def _lit(
    scene: StillLife, surface: Solid, points: Tensor, normal: Tensor, rays: Tensor, albedo: Tensor
) -> Tensor:
    """Colour [N, 3]: Lambertian shading under one sun with hard shadows, and Phong highlights."""
    light = torch.from_numpy(scene.light.astype(np.float32))
    lambert = (normal @ light).clamp(min=0)
    start = points + 1e-3 * normal
    blocked = torch.zeros(len(points), dtype=torch.bool)
    lowest, highest = start.amin(0), start.amax(0)
    for solid in scene.solids:
        if not isinstance(solid, Disc) and not _shades_none(solid, lowest, highest, light):
            blocked |= solid.hit(start, light) < _FAR
    sun = lambert * (~blocked)
    color = albedo * (_AMBIENT + (1 - _AMBIENT) * sun)[:, None]
    shine = getattr(surface, "shine", 0.0)
    if shine:
        mirrored = rays - 2 * _dot(rays, normal)[:, None] * normal
        color = color + shine * ((mirrored @ light).clamp(min=0) ** 24 * sun)[:, None]
    return color

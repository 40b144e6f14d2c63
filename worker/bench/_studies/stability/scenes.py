"""The scenes of the sweep: each axis makes scenes that differ only in how extreme they are along it.

A scene is rounded to float32 once; every engine and the definition then read exactly the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

SHORT = -8.0
"""Log-scale of an axis that the filter outweighs: 0.04 pixels beside its 0.55. Float64 still resolves its gradient."""

LONG_SIDE, SHORT_SIDE = 768, 64
"""Pixels of the image of needles and grazing planes."""

FEW = 10, 96, 32
"""Needles, and pixels of their image, that take Triton's interpreter seconds."""

GROUPS = ("means", "log_scales", "quats", "logit_opacities", "sh")


@dataclass(frozen=True)
class Scene:
    """Gaussians and a camera, float64 values that float32 holds exactly."""

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    sh: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    def arrays(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five parameter groups."""
        return self.means, self.log_scales, self.quats, self.logit_opacities, self.sh

    def groups(self, dtype: torch.dtype) -> list[Tensor]:
        """Copies of the five parameter groups."""
        return [x.to(dtype, copy=True) for x in self.arrays()]

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Scene:
        """The scene with every array replaced by `change` of it."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {k: change(x) for k, x in arrays.items() if isinstance(x, Tensor)}
        return replace(self, **changed)


def draws(seed: int) -> Callable[..., Tensor]:
    """Standard normal float64 numbers of a shape."""
    g = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)


def intrinsics(focal: float, width: int, height: int) -> Tensor:
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)


def cloud(
    n: int = 40, *, seed: int = 0, width: int = 96, height: int = 96, focal: float = 80.0, depth: float = 3.0
) -> Scene:
    """Gaussians of about 3 pixels all over the image, half a unit deep, in a camera that is turned a little."""
    draw = draws(seed)
    pixel = depth / focal
    points = torch.stack(
        [draw(n) * 0.2 * width * pixel, draw(n) * 0.2 * height * pixel, depth + 0.15 * draw(n).clamp(-2, 2)],
        1,
    )
    sh = draw(n, 16, 3) * 0.1
    sh[:, 0] += 1.2  # no colour near the clamp at 0, where the gradient jumps
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]], dtype=torch.float64)
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = turn
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    means = (points - viewmat[:3, 3]) @ turn
    log_scales = math.log(3 * pixel) + 0.3 * draw(n, 3)
    K = intrinsics(focal, width, height)
    return rounded(Scene(means, log_scales, draw(n, 4), draw(n), sh, viewmat, K, width, height))


def rounded(scene: Scene) -> Scene:
    """The scene with every number rounded to float32."""
    return scene.mapped(lambda x: x.float().double())


def facing(scene: Scene, points: Tensor, quats: Tensor, **changed: Any) -> Scene:
    """The scene with means and rotations given in camera space, in a camera at the origin."""
    viewmat = torch.eye(4, dtype=torch.float64)
    return rounded(replace(scene, means=points, quats=quats, viewmat=viewmat, **changed))


def in_plane(angle: Tensor) -> Tensor:
    """Quaternions [N,4] of turns about the viewing axis."""
    return torch.stack([torch.cos(angle / 2), 0 * angle, 0 * angle, torch.sin(angle / 2)], 1)


def needles(ratio: float, seed: int, n: int = 24, width: int = LONG_SIDE, height: int = SHORT_SIDE) -> Scene:
    """Needles in the image plane, centres on the image; the short axis is the 0.3 pixel^2 of the filter alone."""
    focal, depth = 400.0, 3.0
    scene, draw = cloud(n, seed=seed, width=width, height=height, focal=focal), draws(seed + 100)
    spread = 0.8 * width / LONG_SIDE, 0.1 * height / SHORT_SIDE  # world units
    points = torch.stack([draw(n) * spread[0], draw(n) * spread[1], depth + 0.2 * draw(n)], 1)
    log_scales = torch.full((n, 3), SHORT, dtype=torch.float64)
    log_scales[:, 0] = math.log(math.sqrt(0.3) * ratio * depth / focal)
    angle = torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * math.pi
    return facing(scene, points, in_plane(angle), log_scales=log_scales)


def needles_beside(
    ratio: float, seed: int, n: int = 24, width: int = LONG_SIDE, height: int = SHORT_SIDE
) -> Scene:
    """Needles that cross the image with centres 3000 pixels from its middle."""
    focal, depth, away = 400.0, 3.0, 3000.0
    scene, draw = cloud(n, seed=seed, width=width, height=height, focal=focal), draws(seed + 200)
    angle = torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * math.pi
    along = torch.stack([torch.cos(angle), torch.sin(angle)], 1)
    across = torch.stack([-along[:, 1], along[:, 0]], 1)
    pixels = along * away + across * (60 * width / LONG_SIDE * draw(n))[:, None]
    z = depth + 0.2 * draw(n)
    points = torch.cat([pixels * (z / focal)[:, None], z[:, None]], 1)
    log_scales = torch.full((n, 3), SHORT, dtype=torch.float64)
    log_scales[:, 0] = math.log(math.sqrt(0.3) * ratio * depth / focal)
    return facing(scene, points, in_plane(angle), log_scales=log_scales)


def few_needles(ratio: float, seed: int) -> Scene:
    return needles(ratio, seed, *FEW)


def few_needles_beside(ratio: float, seed: int) -> Scene:
    return needles_beside(ratio, seed, *FEW)


def discs(ratio: float, seed: int) -> Scene:
    """Discs in any direction whose thickness is their radius over `ratio`."""
    scene = cloud(seed=seed)
    log_scales = torch.full((40, 3), math.log(0.3), dtype=torch.float64)
    log_scales[:, 2] = math.log(0.3 / ratio)
    return rounded(replace(scene, log_scales=log_scales))


def grazing(ratio: float, seed: int) -> Scene:
    """Planes of 300 pixels and no thickness, seen at an angle of 1/ratio; sharper than the filter from 500 on."""
    n, focal = 24, 400.0
    scene, draw = cloud(n, seed=seed, width=LONG_SIDE, height=SHORT_SIDE, focal=focal), draws(seed + 300)
    points = torch.stack([draw(n) * 0.8, draw(n) * 0.1, 3 + 0.2 * draw(n)], 1)
    # The normal stands at a right angle to the viewing ray, all but 1/ratio, in any direction around it.
    ray = points / points.norm(dim=1, keepdim=True)
    side = torch.linalg.cross(ray, draw(n, 3))
    normal = side / side.norm(dim=1, keepdim=True) + ray / ratio
    log_scales = torch.full((n, 3), math.log(2.0), dtype=torch.float64)
    log_scales[:, 2] = SHORT
    return facing(scene, points, onto_z(normal), log_scales=log_scales)


def onto_z(normal: Tensor) -> Tensor:
    """Quaternions [N,4] that turn the z axis to the normals [N,3]."""
    normal = normal / normal.norm(dim=1, keepdim=True)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=normal.dtype).expand_as(normal)
    return torch.cat([1 + normal[:, 2:], torch.linalg.cross(z, normal)], 1)


def depths(ratio: float, seed: int) -> Scene:
    """One scene of fixed size, whose nearest point is at `ratio` times the near plane of 0.01."""
    scene, draw = cloud(seed=seed), draws(seed + 400)
    deep = 0.01 * ratio + torch.cat([torch.zeros(1, dtype=torch.float64), draw(39).abs()])
    points = torch.stack([draw(40) * 0.3 * deep, draw(40) * 0.3 * deep, deep], 1)
    log_scales = math.log(0.02) + 0.5 * draw(40, 3)
    return facing(scene, points, scene.quats, log_scales=log_scales)


def off_axis(tangent: float, seed: int) -> Scene:
    """The image covers directions whose x/z is about `tangent`: the principal point is far to its left."""
    scene = cloud(seed=seed)
    points = scene.means @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3]
    points[:, 0] += tangent * points[:, 2]
    K = scene.K.clone()
    K[0, 2] -= tangent * K[0, 0]
    return facing(scene, points, scene.quats, K=K, log_scales=scene.log_scales)


def focal(relative: float, seed: int) -> Scene:
    """A fixed scene with detail of every size, through lenses from very wide to very long."""
    n = 60
    scene, draw = cloud(n, seed=seed), draws(seed + 500)
    size = 10.0 ** torch.linspace(0, -4, n, dtype=torch.float64)
    points = torch.stack([draw(n) * size, draw(n) * size, 3 + draw(n).clamp(-2, 2) * size], 1)
    log_scales = torch.log(size)[:, None] * torch.ones(1, 3, dtype=torch.float64) - 1.5 + 0.3 * draw(n, 3)
    K = intrinsics(relative * 96, 96, 96)
    return facing(scene, points, scene.quats, log_scales=log_scales, K=K)


def pile(length: float, seed: int) -> Scene:
    """`length` Gaussians over the same 16 pixels, with opacities just above the 1/255 cut; a tenth stands out."""
    n = int(length)
    scene, draw = cloud(n, seed=seed, width=4, height=4), draws(seed + 600)
    points = torch.stack([draw(n) * 0.05, draw(n) * 0.05, 3 + draw(n).clamp(-2, 2)], 1)
    logits = torch.full((n,), math.log(0.006 / 0.994), dtype=torch.float64)
    logits[::10] = math.log(0.02 / 0.98)
    return facing(scene, points, scene.quats, logit_opacities=logits, log_scales=scene.log_scales + 1.0)


def opacity(logit: float, seed: int) -> Scene:
    scene = cloud(seed=seed)
    return rounded(replace(scene, logit_opacities=torch.full((40,), logit, dtype=torch.float64)))


def distance(units: float, seed: int) -> Scene:
    """Scene and camera moved together, `units` from the origin."""
    scene = cloud(seed=seed)
    offset = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64) * units
    viewmat = scene.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ offset
    return rounded(replace(scene, means=scene.means + offset, viewmat=viewmat))


def sh_size(size: float, seed: int) -> Scene:
    """Coefficients of degree 1 to 3 of the given size, under colours that stay above the clamp."""
    scene = cloud(seed=seed)
    sh = scene.sh * (10 * size)
    sh[:, 0] = 1.2 + 12 * size
    return rounded(replace(scene, sh=sh))


def sh_direction(angle: float, seed: int) -> Scene:
    """Gaussians seen within `angle` of the z axis, where most of the basis vanishes."""
    scene, draw = cloud(seed=seed), draws(seed + 700)
    z = 3 + draw(40).clamp(-2, 2) * 0.2
    points = torch.stack([draw(40) * angle * z, draw(40) * angle * z, z], 1)
    K = scene.K.clone()
    K[0, 0] = K[1, 1] = min(80.0, 20 / angle)
    return facing(scene, points, scene.quats, log_scales=scene.log_scales - 0.5, K=K)


def wide(width: float, seed: int) -> Scene:
    """An image of `width` x 32 pixels, with Gaussians of 3 pixels all over it."""
    side = int(width)
    return cloud(seed=seed, width=side, height=32, focal=0.8 * side)


def twins(apart: float, seed: int) -> Scene:
    """Pairs of Gaussians that differ by `apart` in depth, and stand in the order of their depths."""
    scene = cloud(seed=seed)
    points = scene.means @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3]
    points = points[torch.argsort(points[:, 2])]
    second = points + torch.tensor([0.0, 0.0, apart], dtype=torch.float64)
    both = torch.stack([points, second], 1).reshape(-1, 3)

    def twice(x: Tensor) -> Tensor:
        return x.repeat_interleave(2, 0)

    arrays = {k: twice(getattr(scene, k)) for k in ("log_scales", "logit_opacities", "sh")}
    return facing(scene, both, twice(scene.quats), **arrays)


def quaternion(norm: float, seed: int) -> Scene:
    scene = cloud(seed=seed)
    return rounded(replace(scene, quats=scene.quats / scene.quats.norm(dim=1, keepdim=True) * norm))


@dataclass(frozen=True)
class Axis:
    """One way to make a scene extreme.

    dear: a scene takes seconds, so that one seed has to do.
    tiny: a scene is small enough for the GPU's kernels in Triton's interpreter.
    """

    name: str
    label: str
    values: list[float]
    make: Callable[[float, int], Scene]
    dear: bool = False
    log: bool = True
    tiny: bool = False


AXES = [
    Axis(
        "axis_ratio", "axis ratio of needles on the image", [1, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6], needles, True
    ),
    Axis(
        "beside", "axis ratio of needles centred 3000 pixels off", [3e3, 1e4, 1e5, 1e6], needles_beside, True
    ),
    Axis(
        "axis_ratio_tiny",
        "axis ratio of needles on an image of 96 x 32",
        [1, 1e2, 1e4, 1e6],
        few_needles,
        tiny=True,
    ),
    Axis(
        "beside_tiny",
        "axis ratio of needles 3000 pixels off one of 96 x 32",
        [3e3, 1e4, 1e5, 1e6],
        few_needles_beside,
        tiny=True,
    ),
    Axis("discs", "radius / thickness of discs", [1, 1e2, 1e4, 1e6], discs),
    Axis("grazing", "1 / angle at which planes are seen", [1, 1e2, 1e4, 1e6], grazing, True),
    Axis("depth", "nearest depth / near plane", [1.5, 1e1, 1e2, 1e3, 1e4, 1e5], depths),
    Axis("off_axis", "tangent of the angle off the axis", [0.01, 1, 1e1, 1e2, 1e3], off_axis),
    Axis("focal", "focal length / image width", [0.1, 1, 1e1, 1e2, 1e3], focal),
    Axis("list_length", "Gaussians on one list", [1, 1e1, 1e2, 1e3, 1e4, 1e5], pile, True),
    Axis("opacity", "logit of the opacity", [-5.4, -5, -2, 2, 6, 10, 13, 16], opacity, log=False),
    Axis("distance", "distance from the origin", [1, 1e2, 1e3, 1e4, 1e5], distance),
    Axis("sh_size", "size of SH coefficients", [1e-3, 1, 1e3, 1e6], sh_size),
    Axis("sh_direction", "angle between direction and pole", [1e-6, 1e-4, 1e-2, 0.3], sh_direction),
    Axis("width", "image width, pixels", [32, 128, 512, 2048, 8192], wide),
    Axis("twins", "depth between near-duplicates", [1e-1, 1e-3, 1e-5, 1e-8], twins),
    Axis("quaternion", "norm of the quaternion", [1e-30, 1e-18, 1, 1e18, 1e30], quaternion),
]

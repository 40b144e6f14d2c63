"""Scenes of one to three Gaussians by a vector of numbers in [0, 1], so that a search reaches all that is extreme.

Every vector gives a scene whose Gaussians reach the image, however long and far off they are: a Gaussian is made from
a pixel that it crosses, the direction and length of its longest axis in the image, and the share of that axis by which
its centre lies away. Lengths, depths and angles are spread over decades, and their special values (0, the same again)
are met exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from _studies.functions.tolerances import U
from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected
from splatmill_worker.splat.lod.moments import quaternions

from .scenes import Scene, draws, rounded

SIDE = 16
"""Pixels of the image's sides: one tile, so that a scene takes tens of milliseconds."""

NEAR = 0.01

Numbers = Sequence[float]


def between(t: float, low: float, high: float) -> float:
    return low + t * (high - low)


def decades(t: float, low: float, high: float) -> float:
    """10^low to 10^high."""
    value: float = 10.0 ** between(t, low, high)
    return value


def signed(t: float, low: float, high: float) -> float:
    """-10^high to -10^low, 0 for a tenth of the range, 10^low to 10^high."""
    s = 2 * t - 1
    return 0.0 if abs(s) < 0.1 else math.copysign(decades((abs(s) - 0.1) / 0.9, low, high), s)


@dataclass(frozen=True)
class Lens:
    """A camera, and what it turns camera space by into the world: point = turn world + shift."""

    fx: float
    fy: float
    cx: float
    cy: float
    turn: Tensor
    shift: Tensor

    def held(self, u: float, v: float) -> tuple[float, float]:
        """x/z and y/z within 15 % of the image beyond its edges, where the Jacobian is taken."""
        (low_u, high_u), (low_v, high_v) = self.bounds()
        return min(max(u, low_u), high_u), min(max(v, low_v), high_v)

    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (
            (-(0.15 * SIDE + self.cx) / self.fx, (1.15 * SIDE - self.cx) / self.fx),
            (-(0.15 * SIDE + self.cy) / self.fy, (1.15 * SIDE - self.cy) / self.fy),
        )


LENS = 6
"""Numbers of a lens."""


def lens(t: Numbers) -> Lens:
    """Focal length 3 to 30,000 pixels, principal point up to 3,000 pixels off, origin up to 10^4 away."""
    focal = decades(t[0], 0.5, 4.5)
    turn, shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    if t[4] > 0.3:
        x, y, z = (signed((t[4] - 0.3) / 0.7, -6, 0.4) * a for a in (0.3, -0.8, 0.5))
        turn = torch.linalg.matrix_exp(
            torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        )
        shift = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64) * decades(t[5], -2, 4)
    cx, cy = (SIDE / 2 + signed(x, 0, 3.5) for x in t[2:4])
    return Lens(focal, focal * between(t[1], 0.8, 1.25), cx, cy, turn, shift)


SPLAT = 12
"""Numbers of a Gaussian."""


@dataclass(frozen=True)
class Splat:
    """One Gaussian in camera space."""

    point: Tensor  # [3]
    log_scales: Tensor  # [3]
    axes: Tensor  # [3,3] columns: its axes
    logit: float
    sh_size: float


def splat(t: Numbers, at: Lens) -> Splat:
    """A Gaussian by its numbers.

    0, 1: the pixel that its longest axis crosses. 2: depth, from the near plane to 1,000. 3: that axis in the image,
    0.01 to 10^6 pixels. 4, 5: the second axis over the first and the third over the second, 10^-6 to 1. 6: where on
    the first axis its centre lies, in standard deviations. 7: direction of the axis in the image. 8: its slope in
    depth. 9: roll about it; at 0 the second axis lies along the viewing ray, which is a disc seen from its edge. 10:
    logit, from the cut to 16. 11: size of the harmonics, 10^-3 to 10^3.
    """
    px, py = (between(x, -2, SIDE + 2) for x in t[:2])
    z = NEAR * (1 + decades(t[2], -6, 5))
    long = decades(t[3], -2, 6)
    angle = math.pi * t[7]
    along = between(t[6], -3.2, 3.2) * long
    x2d, y2d = px + along * math.cos(angle), py + along * math.sin(angle)
    u, v = (x2d - at.cx) / at.fx, (y2d - at.cy) / at.fy
    held_u, held_v = at.held(u, v)
    ray = torch.tensor([held_u, held_v, 1.0], dtype=torch.float64)
    # Its projection has the direction (cos, sin), whatever the slope is.
    flat = torch.tensor([math.cos(angle) / at.fx, math.sin(angle) / at.fy, 0.0], dtype=torch.float64)
    first = flat + signed(t[8], -4, 2) / at.fx * ray
    length = float(first.norm())
    first = first / length
    second = ray - (ray @ first) * first
    second = second / second.norm()
    third = torch.linalg.cross(first, second)
    roll = signed(t[9], -6, math.log10(math.pi / 2))
    second, third = (
        math.cos(roll) * second + math.sin(roll) * third,
        math.cos(roll) * third - math.sin(roll) * second,
    )
    sizes = [math.log(long * z * length)]
    for ratio in t[4:6]:
        sizes.append(sizes[-1] + math.log(10) * between(ratio, -6, 0))
    return Splat(
        torch.tensor([u * z, v * z, z], dtype=torch.float64),
        torch.tensor(sizes, dtype=torch.float64),
        torch.stack([first, second, third], 1),
        between(t[10], -5.53, 16.0),
        decades(t[11], -3, 3),
    )


def placed(splats: Sequence[Splat], at: Lens) -> Scene:
    """Gaussians of camera space before a lens, rounded to float32."""
    draw = draws(5)
    sizes = torch.tensor([s.sh_size for s in splats], dtype=torch.float64)
    sh = draw(len(splats), 16, 3) * sizes[:, None, None]
    sh[:, 0] = 1.2 + 12 * sizes[:, None]  # no colour near the clamp at 0, where the gradient jumps
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = at.turn, at.shift
    points = torch.stack([s.point for s in splats])
    K = torch.tensor([[at.fx, 0, at.cx], [0, at.fy, at.cy], [0, 0, 1]], dtype=torch.float64)
    return rounded(
        Scene(
            means=(points - at.shift) @ at.turn,
            log_scales=torch.stack([s.log_scales for s in splats]),
            quats=quaternions(torch.stack([at.turn.T @ s.axes for s in splats])),
            logit_opacities=torch.tensor([s.logit for s in splats], dtype=torch.float64),
            sh=sh,
            viewmat=viewmat,
            K=K,
            width=SIDE,
            height=SIDE,
        )
    )


def several(count: int) -> Callable[[Numbers], Scene]:
    def make(t: Numbers) -> Scene:
        at = lens(t)
        return placed([splat(t[LENS + SPLAT * i :], at) for i in range(count)], at)

    return make


def twins(t: Numbers) -> Scene:
    """One Gaussian twice, with all but its colour moved by 10^-8 to 10^-1 of its range, in a camera at the origin."""
    at = lens([*t[:4], 0.0, 0.0])
    one = t[LENS : LENS + SPLAT]
    apart = decades(t[LENS + SPLAT], -8, -1)
    other = [min(max(x + apart * (1 if x < 0.5 else -1), 0.0), 1.0) for x in one]
    return placed([splat(one, at), splat([*other[:-1], one[-1]], at)], at)


def needle(t: Numbers) -> Scene:
    """One Gaussian of 150 to 10^6 pixels, whose second axis is a sixteenth of that at most."""
    t = list(t)
    t[LENS + 3] = between(t[LENS + 3], 0.52, 1)
    t[LENS + 4] *= 0.8
    return several(1)(t)


def disc(t: Numbers) -> Scene:
    """One Gaussian with two equal axes and a third of a thousandth of them at most, seen near its edge."""
    t = list(t)
    t[LENS + 4], t[LENS + 5] = 1.0, 0.5 * t[LENS + 5]
    t[LENS + 9] = between(t[LENS + 9], 0.2, 0.8)
    return several(1)(t)


@dataclass(frozen=True)
class Family:
    """Scenes of one build: how many numbers make one."""

    name: str
    numbers: int
    make: Callable[[Numbers], Scene]


FAMILIES = {
    family.name: family
    for family in (
        Family("one", LENS + SPLAT, several(1)),
        Family("needle", LENS + SPLAT, needle),
        Family("disc", LENS + SPLAT, disc),
        Family("twins", LENS + SPLAT + 1, twins),
        Family("two", LENS + 2 * SPLAT, several(2)),
        Family("three", LENS + 3 * SPLAT, several(3)),
    )
}


def projected(scene: Scene) -> Projected:
    """What the definition projects the Gaussians to."""
    with torch.no_grad():
        return ops.project(
            *scene.arrays(), scene.viewmat, scene.K, scene.width, scene.height,
            degree=3, near=NEAR, backend="reference",
        )  # fmt: skip


def decided(scene: Scene) -> bool:
    """Whether something is drawn, and no decision beside those at pixels lies within the reach of rounding.

    These are the order of depths, the near plane, and the bounds of x/z and y/z, where the image or its gradient jumps
    as a whole. (The thresholds of alpha are decided for each pixel: `Problem.undecided`.)
    """
    if not (projected(scene).extents > 0).any():
        return False
    W, t = scene.viewmat[:3, :3], scene.viewmat[:3, 3]
    points = scene.means @ W.T + t
    reach = 64 * U * (scene.means.abs() @ W.abs().T + t.abs())
    exact = torch.equal(W, torch.eye(3, dtype=W.dtype)) and not t.any()
    z, off = points[:, 2], reach[:, 2]
    if ((z - NEAR).abs() <= off).any():
        return False
    for i in range(len(z)):
        for j in range(i):
            if not exact and (z[i] - z[j]).abs() <= off[i] + off[j]:
                return False
    K = scene.K
    for axis, side in enumerate((scene.width, scene.height)):
        ratio = points[:, axis] / z
        unsure = (reach[:, axis] + ratio.abs() * off) / z.abs() + 64 * U * ratio.abs()
        for edge in (-0.15 * side, 1.15 * side):
            bound = (edge - K[axis, 2]) / K[axis, axis]
            if ((ratio - bound).abs() <= unsure + 64 * U * (side + K[axis, 2].abs()) / K[axis, axis]).any():
                return False
    return True

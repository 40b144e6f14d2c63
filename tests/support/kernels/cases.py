"""The scenes every backend is proven on: one list, so that a new backend inherits all of it.

Numbers are made in float32, so that float64 and float32 code read exactly the same scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected

GROUPS = ("means", "log_scales", "quats", "logit_opacities", "sh")


@dataclass(frozen=True)
class Case:
    """One scene in one camera. `lenient` says why, where a property of the scene widens what can be asked of it."""

    name: str
    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    sh: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    degree: int = 3
    antialias: bool = False
    near: float = 0.01
    background: Tensor = field(default_factory=lambda: torch.tensor([0.25, 0.5, 0.125]))

    def groups(self, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five parameter groups, fresh leaves."""
        means, log_scales, quats, logits, sh = (getattr(self, name).to(dtype).clone() for name in GROUPS)
        return means, log_scales, quats, logits, sh

    def project(self, groups: Sequence[Tensor], viewmat: Tensor, backend: ops.Backend) -> Projected:
        """Project groups into this case's camera, as it is or moved, in their dtype and on their device."""
        means, log_scales, quats, logit_opacities, sh = groups
        return ops.project(
            means, log_scales, quats, logit_opacities, sh, viewmat, self.K.to(viewmat), self.width, self.height,
            degree=self.degree, near=self.near, antialias=self.antialias, backend=backend,
        )  # fmt: skip

    def camera(self, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
        """viewmat and K, fresh leaves."""
        return self.viewmat.to(dtype).clone(), self.K.to(dtype).clone()


def _viewmat(yaw: float, pitch: float, shift: tuple[float, float, float]) -> Tensor:
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    turn = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=torch.float64)
    nod = torch.tensor([[1, 0, 0], [0, cp, -sp], [0, sp, cp]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = nod @ turn
    viewmat[:3, 3] = torch.tensor(shift, dtype=torch.float64)
    return viewmat.float()


def scene(
    name: str, n: int = 200, *, width: int = 61, height: int = 47, seed: int = 0, degree: int = 3
) -> Case:
    """A cloud of moderate Gaussians in front of a camera that faces them aslant."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    focal = 0.8 * max(width, height)
    sh = draw(n, 16, 3) * 0.15
    sh[:, 0] = draw(n, 3) * 0.8
    return Case(
        name,
        means=draw(n, 3) * torch.tensor([1.2, 1.0, 0.6]),
        log_scales=draw(n, 3) * 0.5 - 2.0,
        quats=draw(n, 4),
        logit_opacities=draw(n) * 1.5,
        sh=sh,
        viewmat=_viewmat(0.3, 0.2, (0.1, -0.2, 3.0)),
        K=torch.tensor([[focal, 0, 0.48 * width], [0, 1.05 * focal, 0.53 * height], [0, 0, 1]]),
        width=width,
        height=height,
        degree=degree,
    )


def _with_scales(case: Case, name: str, log_scales: Tensor) -> Case:
    return replace(case, name=name, log_scales=log_scales.float())


def _needles(ratio: float) -> Case:
    case = scene("", 120, seed=3)
    log_scales = torch.full((120, 3), math.log(0.5 / ratio))
    log_scales[torch.arange(120), torch.arange(120) % 3] = math.log(0.5)
    return _with_scales(case, f"needles {ratio:.0e}", log_scales)


def _long_needles(ratio: float) -> Case:
    """Needles of which only the long axis is wider than the blur: the projected axes differ by `ratio`."""
    case = scene("", 60, seed=26)
    log_scales = torch.full((60, 3), -20.0)
    log_scales[:, 0] = math.log(0.03 * ratio)
    return _with_scales(
        replace(case, logit_opacities=torch.full((60,), -1.5)), f"long needles {ratio:.0e}", log_scales
    )


def _discs() -> Case:
    case = scene("", 120, seed=4)
    log_scales = torch.full((120, 3), math.log(0.3))
    log_scales[torch.arange(120), torch.arange(120) % 3] = math.log(3e-5)
    return _with_scales(case, "discs", log_scales)


def _near_plane() -> Case:
    """Depths from behind the camera through the plane at 0.01 to just before it."""
    case = scene("near plane", 120, seed=5)
    depth = torch.cat([torch.linspace(-0.5, 0.0099, 60), torch.logspace(math.log10(0.0101), 0, 60)])
    points = torch.cat(
        [
            torch.randn(120, 2, generator=torch.Generator().manual_seed(6)) * depth.abs()[:, None],
            depth[:, None],
        ],
        1,
    )
    R, t = case.viewmat[:3, :3].double(), case.viewmat[:3, 3].double()
    means = ((points.double() - t) @ R).float()
    return replace(case, means=means, log_scales=torch.full((120, 3), math.log(3e-3)))


def _far_off_axis() -> Case:
    """Centres far outside the image with footprints that reach in: the Jacobian's clamp acts."""
    case = scene("far off-axis", 80, seed=7)
    means = case.means.clone()
    means[:, 0] *= 6.0
    means[:, 1] *= 4.0
    return replace(
        case,
        means=means,
        log_scales=torch.full((80, 3), math.log(1.5)),
        logit_opacities=torch.full((80,), -2.0),
    )


def _pile(name: str, n: int, logit: float) -> Case:
    """n Gaussians on the line of sight of one pixel."""
    case = scene(name, n, width=20, height=18, seed=8)
    depth = 2 + 4 * torch.rand(n, generator=torch.Generator().manual_seed(9))
    ray = torch.tensor([(7.5 - case.K[0, 2]) / case.K[0, 0], (9.5 - case.K[1, 2]) / case.K[1, 1], 1.0])
    R, t = case.viewmat[:3, :3].double(), case.viewmat[:3, 3].double()
    means = ((depth[:, None].double() * ray.double() - t) @ R).float()
    return replace(
        case,
        means=means,
        log_scales=torch.full((n, 3), math.log(0.05)),
        logit_opacities=torch.full((n,), logit),
    )


def _opacity_ends() -> Case:
    case = scene("opacity ends", 64, seed=10)
    edge = math.log((1 / 255) / (1 - 1 / 255))
    values = [-80.0, -20.0, edge - 1e-3, edge + 1e-3, edge + 0.1, 0.0, 6.9, 7.0, 12.0, 20.0, 80.0]
    return replace(case, logit_opacities=torch.tensor([values[i % len(values)] for i in range(64)]))


def _opaque_and_wide() -> Case:
    """Many pixels of every Gaussian stand above 0.999, where alpha is held and its gradient ends."""
    case = scene("opaque and wide", 20, seed=27)
    return replace(
        case, log_scales=torch.full((20, 3), math.log(1.5)), logit_opacities=torch.linspace(6.9, 14.0, 20)
    )


def _principal_point() -> Case:
    case = scene("principal point off centre", seed=11)
    K = case.K.clone()
    K[0, 2], K[1, 2] = 4.0, 44.0
    return replace(case, K=K)


def _camera_inside() -> Case:
    """The camera stands inside a large Gaussian whose centre is just before it."""
    case = scene("camera inside a splat", 40, seed=12)
    center = -(case.viewmat[:3, :3].T @ case.viewmat[:3, 3])
    means, log_scales, logits = case.means.clone(), case.log_scales.clone(), case.logit_opacities.clone()
    means[0] = center + case.viewmat[2, :3] * 0.25
    log_scales[0], logits[0] = math.log(1.0), -1.0
    return replace(case, means=means, log_scales=log_scales, logit_opacities=logits)


def _all_culled() -> Case:
    case = scene("all culled", 30, seed=13)
    behind = -(case.viewmat[:3, :3].T @ case.viewmat[:3, 3]) - case.viewmat[2, :3] * 2
    return replace(case, means=behind + 0.1 * case.means)


def _antialias_floor() -> Case:
    """Points whose compensation is held at its floor, root of 2.5e-5, and which are visible by that alone."""
    case = scene("", 40, seed=29)
    case = _with_scales(case, "antialias at its floor", torch.full((40, 3), math.log(1e-4)))
    return replace(case, antialias=True, logit_opacities=torch.full((40,), 3.0))


def _huge() -> Case:
    case = scene("huge", 12, seed=14)
    return replace(
        case, log_scales=torch.full((12, 3), math.log(40.0)), logit_opacities=torch.full((12,), -1.5)
    )


def _dark() -> Case:
    """Colours that the clamp at 0 holds in about half of the channels."""
    case = scene("dark", 100, seed=15)
    sh = case.sh.clone()
    sh[:, 0] -= 1.8
    return replace(case, sh=sh)


def _equal_depths() -> Case:
    """Ties in depth, resolved by index: a camera along the axis and all means in one plane."""
    case = scene("equal depths", 60, seed=16)
    means = case.means.clone()
    means[:, 2] = 0.0
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    return replace(case, means=means, viewmat=viewmat)


_MAKERS: list[Callable[[], Case]] = [
    lambda: scene("ordinary"),
    lambda: scene("degree 0", degree=0, seed=1),
    lambda: scene("degree 1", degree=1, seed=1),
    lambda: scene("degree 2", degree=2, seed=1),
    lambda: replace(scene("antialias", seed=2), antialias=True),
    lambda: _needles(1e2),
    lambda: _needles(1e4),
    lambda: _needles(1e6),
    lambda: _long_needles(1e2),
    lambda: _long_needles(1e4),
    lambda: _long_needles(1e6),
    _discs,
    lambda: _with_scales(scene("", seed=17), "sub-pixel", torch.full((200, 3), math.log(1e-4))),
    lambda: replace(
        _with_scales(scene("", seed=17), "sub-pixel antialias", torch.full((200, 3), math.log(1e-2))), antialias=True
    ),
    _antialias_floor,
    _huge,
    _near_plane,
    _far_off_axis,
    lambda: _pile("pile of transparent", 3000, -4.5),
    lambda: _pile("pile of opaque", 1000, 4.0),
    _opacity_ends,
    _opaque_and_wide,
    _principal_point,
    lambda: scene("portrait", 150, width=33, height=90, seed=18),
    lambda: scene("side 1x1", 60, width=1, height=1, seed=19),
    lambda: scene("side 15x16", 60, width=15, height=16, seed=20),
    lambda: scene("side 16x17", 60, width=16, height=17, seed=21),
    lambda: scene("side 257x1", 60, width=257, height=1, seed=22),
    lambda: scene("side 17x257", 100, width=17, height=257, seed=23),
    lambda: scene("one Gaussian", 1, seed=24),
    lambda: scene("zero Gaussians", 0),
    lambda: scene("a block and one", 17, seed=25),
    _all_culled,
    _camera_inside,
    _dark,
    _equal_depths,
]  # fmt: skip

CASES: dict[str, Callable[[], Case]] = {maker().name: maker for maker in _MAKERS}

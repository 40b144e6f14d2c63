"""What the proofs share: running a case on a backend, and how far float32 may be from the definition."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
import torch
from _studies.functions.tolerances import ALPHA_ERROR
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.records import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Bins, Projected
from tests.support.kernels.cases import GROUPS, Case

EPS = 2.0**-24  # half a unit in the last place of float32


def backends() -> list[object]:
    """Every backend that can run here: the builds of the CPU engine, and gpu where there is one.

    Triton's interpreter needs minutes for what takes a device seconds: it is proven on a few scenes by test_gpu_ops,
    and on all of these where SPLATMILL_PROVE_INTERPRETER=1 asks for it.
    """
    choices: list[object] = [f"cpu:{name}" for name in isa.supported()]
    if torch.cuda.is_available() or os.environ.get("SPLATMILL_PROVE_INTERPRETER") == "1":
        choices.append(pytest.param("gpu", marks=pytest.mark.gpu))
    return choices


def where(op: str) -> str:
    """The device that a backend's tensors lie on: a card for gpu where there is one, else the processor."""
    return "cuda" if op == "gpu" and torch.cuda.is_available() else "cpu"


@contextmanager
def use(backend: str) -> Iterator[ops.Backend]:
    """Run with a backend, or with one build of the CPU engine (`cpu:avx2`); yields the backend's name as ops take it.

    Raises ValueError for any other name, so that a misspelt build is not proven by another one.
    """
    if backend.startswith("cpu:"):
        with _build(backend.removeprefix("cpu:")):
            yield "cpu"
    elif backend == "reference":
        yield "reference"
    elif backend == "gpu":
        yield "gpu"
    else:
        raise ValueError(f"backend: expected reference, gpu or cpu:BUILD, got {backend!r}")


@contextmanager
def _build(name: str) -> Iterator[None]:
    """Put one build of the CPU engine in the place of the chosen one, in every module that holds it."""
    engine = isa.load(name)
    prefix = "splatmill_worker.kernels.cpu"
    modules = [m for k, m in sys.modules.items() if k.startswith(prefix) and hasattr(m, "engine")]
    before = [m.engine for m in modules]
    for m in modules:
        vars(m)["engine"] = engine
    try:
        yield
    finally:
        for m, old in zip(modules, before, strict=True):
            vars(m)["engine"] = old


@dataclass
class Run:
    """One case through project, bin and composite, with the leaves that gradients arrive at."""

    leaves: dict[str, Tensor]  # the five groups, viewmat and background
    projected: Projected
    bins: Bins
    color: Tensor
    alpha: Tensor
    depth: Tensor

    def gradients(self, d_color: Tensor, d_alpha: Tensor, d_depth: Tensor) -> dict[str, Tensor]:
        """Gradients of the weighted sum of the three images to every leaf."""
        total = weighted((self.color, self.alpha, self.depth), (d_color, d_alpha, d_depth))
        grads = torch.autograd.grad(total, list(self.leaves.values()), allow_unused=True)
        pairs = zip(self.leaves.items(), grads, strict=True)
        return {k: torch.zeros_like(x) if g is None else g for (k, x), g in pairs}


def run(case: Case, backend: ops.Backend, dtype: torch.dtype = torch.float32) -> Run:
    """Project, bin and composite a case."""
    device = where(backend)
    names = (*GROUPS, "viewmat", "background")
    tensors = [*case.groups(), case.viewmat, case.background]
    leaves = {
        k: x.detach().clone().to(device, dtype).requires_grad_() for k, x in zip(names, tensors, strict=True)
    }
    projected = case.project([leaves[k] for k in GROUPS], leaves["viewmat"], backend)
    bins = ops.bin(projected, case.width, case.height, backend=backend)
    image = ops.composite(
        projected, bins, case.width, case.height, background=leaves["background"], backend=backend
    )
    return Run(leaves, projected, bins, *image)


def filled(projected: Projected, fields: Sequence[Tensor]) -> Projected:
    """Projected Gaussians with other fields, all but the extents, which follow in dtype and device."""
    moved = dict(zip(Projected._fields, fields, strict=False))
    return projected._replace(**moved, extents=projected.extents.to(fields[0]))


def weighted(images: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """The sum of images times weights, which may have another dtype and device."""
    return torch.stack([(x * w.to(x)).sum() for x, w in zip(images, weights, strict=True)]).sum()


def define(case: Case) -> Run:
    """The definition: the reference in float64."""
    return run(case, "reference", torch.float64)


def alpha_error(case: Case, exact: Projected) -> Tensor:
    """How far, relatively, float32 may put each Gaussian's alpha [N], to first order, from the definition.

    alpha = o 2^(-q/2 log2 e), q = d^T C d <= 2 ln 255 = 11. A camera-space coordinate is a sum of four products,
    known to 4 eps (|mean| + |t|). Divided by z it moves the centre by that times f/z (1 + |u|), and rounding the
    pixel coordinate by 2 eps |coordinate|; alpha's slope along q is at most sqrt(11 lambda_max(C)) <= 6 per pixel.
    Relative errors of the covariance, 2 dz/z + 16 eps, act on q <= 11. The functions and the sum of the exponent add
    ALPHA_ERROR.
    """
    coordinate = 4 * EPS * (case.means.double().abs().sum(1) + case.viewmat[:3, 3].double().abs().sum())
    z = exact.depths.detach()
    visible = (exact.extents > 0).all(1)
    z = torch.where(visible, z, 1.0)
    focal = float(case.K[0, 0].maximum(case.K[1, 1]))
    offset = (exact.means2d.detach() - case.K[:2, 2].double()).abs().amax(1) / focal
    pixels = focal * coordinate / z * (1 + offset) + 2 * EPS * exact.means2d.detach().abs().amax(1)
    a, b, c = exact.conics.detach().unbind(1)
    stiffest = (a + c) / 2 + torch.sqrt(((a - c) / 2) ** 2 + b * b)
    q = 11.0
    error = torch.sqrt(q * stiffest) * pixels + q / 2 * (2 * coordinate / z + 16 * EPS) + ALPHA_ERROR
    return torch.where(visible, error, 0.0)


def conditioning(p: Projected) -> Tensor:
    """a c / (a c - b^2) of each conic [N]: how many roundings of its determinant one of its numbers is.

    inf where rounding has taken the determinant to 0 or below: such a form draws nothing that could be compared. 1 for
    what is culled.
    """
    a, b, c = p.conics.detach().double().unbind(1)
    det = a * c - b * b
    visible = (p.extents > 0).all(1)
    return torch.where(visible, torch.where(det > 0, a * c / det, torch.inf), 1.0)


def record_error(p: Projected) -> Tensor:
    """How far the logarithm of an alpha by a kernel's record may be from that by the conic [N] that it is made of.

    With k = a c / (a c - b^2), no term of q = d^T C d <= Q = 2 ln 255 exceeds k Q inside the ellipse. The record raises
    a c - b^2 to 6e-8 a c, which adds 2 eps k of q at most. u = ux dx + uy dy has four roundings of its two terms, which
    move u^2 by 16 eps sqrt(k) Q, and v = vy dy has four. An edge of the box is rounded by 2 eps (|centre| + extent);
    q grows there by 2 Q / extent for each pixel. The functions and the sum of the exponent add ALPHA_ERROR.
    """
    k = conditioning(p)
    visible = (p.extents > 0).all(1)
    off = torch.where(visible[:, None], p.means2d.double().abs() / p.extents.double(), 0.0).amax(1)
    q = 2 * math.log(1 / ALPHA_MIN)
    return EPS * q * (k + 8 * torch.sqrt(k) + 4 + 2 * (1 + off)) + ALPHA_ERROR


@dataclass(frozen=True)
class Margins:
    """Per pixel, the relative distance of the nearest alpha from a threshold, in units of its possible error."""

    jump: Tensor  # [H,W] to 1/255, or of the transmittance to its end: the image jumps there
    gate: Tensor  # [H,W] to 0.999: the gradient jumps there


def margins(exact: Projected, bins: Bins, width: int, height: int, error: Tensor) -> Margins:
    """How far every pixel is from a decision that float32 could take otherwise (a value <= 1 may go either way)."""
    columns = -(-width // TILE)
    jump = torch.full((height, width), float("inf"), dtype=torch.float64)
    gate = jump.clone()
    for tile in range(len(bins.offsets) - 1):
        ids = bins.ids[bins.offsets[tile] : bins.offsets[tile + 1]].long()
        if not len(ids):
            continue
        top, left = tile // columns * TILE, tile % columns * TILE
        ys = torch.arange(top, min(top + TILE, height))
        xs = torch.arange(left, min(left + TILE, width))
        y, x = torch.meshgrid(ys + 0.5, xs + 0.5, indexing="ij")
        d = (
            torch.stack([x.reshape(-1, 1), y.reshape(-1, 1)]).double()
            - exact.means2d[ids].detach().T[:, None]
        )
        a, b, c = exact.conics[ids].detach().T[:, None]
        raw = exact.opacities[ids].detach() * torch.exp(
            -0.5 * (a * d[0] ** 2 + c * d[1] ** 2) - b * d[0] * d[1]
        )
        at_cut = ((raw / ALPHA_MIN - 1).abs() / error[ids]).amin(1)
        at_gate = ((raw / ALPHA_MAX - 1).abs() / error[ids]).amin(1)
        alpha = torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), 0.0)
        after = torch.cumprod(1 - alpha, 1)
        # Relative errors of 1 - alpha add up along the list.
        unsure = torch.cumsum(error[ids] * alpha / (1 - alpha) + EPS, 1)
        at_stop = ((after / TRANSMITTANCE_MIN - 1).abs() / unsure).amin(1)
        shape = (len(ys), len(xs))
        jump[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1] = torch.minimum(at_cut, at_stop).reshape(shape)
        gate[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1] = at_gate.reshape(shape)
    return Margins(jump, gate)


def brightest(exact: Run) -> tuple[float, float]:
    """Largest colour and largest depth that any pixel can show."""
    color = max(
        float(exact.leaves["background"].detach().max()), *exact.projected.colors.flatten().tolist(), 1e-6
    )
    return color, max([*exact.projected.depths.tolist(), 1e-6])


def peak(p: Projected, i: int, tile: int, width: int) -> float:
    """The largest alpha of Gaussian i at the pixel centres of a whole tile."""
    columns = -(-width // TILE)
    y, x = torch.meshgrid(
        torch.arange(TILE) + 0.5 + tile // columns * TILE,
        torch.arange(TILE) + 0.5 + tile % columns * TILE,
        indexing="ij",
    )
    dx, dy = x.double() - p.means2d[i, 0].detach(), y.double() - p.means2d[i, 1].detach()
    a, b, c = p.conics[i].detach()
    return float(
        (p.opacities[i].detach() * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).max()
    )

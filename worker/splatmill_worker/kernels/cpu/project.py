"""project on the CPU: sixteen Gaussians to a vector; differentiable in the five groups and the viewmat."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatmill_worker.kernels.records import Projected

from . import blocks, engine


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    degree: int,
    near: float = 0.01,
    antialias: bool = False,
) -> Projected:
    """Project Gaussians into one pinhole camera, as `reference.project` defines it; float32."""
    rows = _Project.apply(  # type: ignore[no-untyped-call]  # torch leaves it untyped
        means, log_scales, quats, logit_opacities, sh, viewmat, K, width, height, degree, near, antialias
    )
    return Projected(*rows)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        near: float,
        antialias: bool,
    ) -> tuple[Tensor, ...]:
        n, threads = len(means), engine.default_threads()
        groups = dict(zip(blocks.FIRST, (means, log_scales, quats, logit_opacities, sh), strict=True))
        camera = engine.Camera(
            viewmat.detach().contiguous(), K.detach().contiguous(), width, height, near, antialias
        )
        packed = blocks.pack(groups, n, threads)
        out = tuple(means.new_empty(n, *shape) for shape in ((2,), (3,), (), (3,), (), (2,)))
        engine.project(packed, n, degree, camera, *out, threads)
        ctx.save_for_backward(packed)
        ctx.camera, ctx.degree, ctx.n, ctx.shapes = camera, degree, n, {k: g.shape for k, g in groups.items()}
        ctx.mark_non_differentiable(out[5])
        return out

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        (packed,) = ctx.saved_tensors
        threads = engine.default_threads()
        grad_blocks, d_viewmat = torch.empty_like(packed), torch.empty(4, 4)
        d = [s.contiguous() for s in slopes[:5]]
        engine.project_backward(packed, ctx.n, ctx.degree, ctx.camera, *d, grad_blocks, d_viewmat, threads)
        grads = blocks.unpack(grad_blocks, ctx.shapes, ctx.n, threads)
        return (*grads.values(), d_viewmat, *[None] * 6)

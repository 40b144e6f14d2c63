"""The definition draws what an independent implementation draws: gsplat's plain-torch code, on the CPU.

gsplat supplies projection, compensation, spherical harmonics and the alpha of every (pixel, Gaussian) pair. Its
compositing calls the package nerfacc, which needs a GPU to build; the two published formulas it calls are written
here. gsplat has no 1/255 ellipse lists, stop or culls of ours: all pairs are tried, and cut and stop applied by their
definitions.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import reference
from tests.support.kernels.cases import Case, scene

pytest.importorskip("gsplat", reason="gsplat is a test dependency: pip install -c constraints.txt gsplat")


def weights_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """alpha_i times the product of 1 - alpha_j over the earlier j of the same ray; rays stand one after another."""
    weights, before = torch.empty_like(alphas), torch.empty_like(alphas)
    left, ray = 1.0, -1
    for i, (a, r) in enumerate(zip(alphas.tolist(), ray_indices.tolist(), strict=True)):
        if r != ray:
            left, ray = 1.0, r
        before[i], weights[i] = left, a * left
        left *= 1 - a
    return weights, before


def along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    each = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, each.shape[1], dtype=each.dtype).index_add(0, ray_indices, each)


def drawn_by_gsplat(case: Case, monkeypatch: pytest.MonkeyPatch) -> tuple[Tensor, Tensor]:
    from gsplat.cuda import _torch_impl as gs  # type: ignore[import-untyped]  # it has no types

    formulas = ModuleType("nerfacc")
    vars(formulas).update(render_weight_from_alpha=weights_from_alpha, accumulate_along_rays=along_rays)
    monkeypatch.setitem(sys.modules, "nerfacc", formulas)

    means, log_scales, quats, logits, sh = case.groups(torch.float64)
    V, K = case.camera(torch.float64)
    covars, _ = gs._quat_scale_to_covar_preci(quats, log_scales.exp(), compute_preci=False)
    _, means2d, depths, conics, compensations = gs._fully_fused_projection(
        means,
        covars,
        V[None],
        K[None],
        case.width,
        case.height,
        near_plane=case.near,
        calc_compensations=case.antialias,
    )
    opacities = torch.sigmoid(logits)[None]
    if case.antialias:
        opacities = opacities * compensations.clamp_min(2.5e-5**0.5)
    center = -V[:3, :3].T @ V[:3, 3]
    colors = gs._spherical_harmonics(case.degree, means - center, sh)[None]
    colors = (colors + 0.5).clamp_min(0.0)

    y, x = torch.meshgrid(torch.arange(case.height) + 0.5, torch.arange(case.width) + 0.5, indexing="ij")
    order = torch.argsort(depths[0], stable=True)
    order = order[(depths[0] > case.near)[order]]
    ids, pixels = [], []
    for pixel, (px, py) in enumerate(zip(x.flatten().tolist(), y.flatten().tolist(), strict=True)):
        d = torch.tensor([px, py], dtype=torch.float64) - means2d[0, order]
        c = conics[0, order]
        power = 0.5 * (c[:, 0] * d[:, 0] ** 2 + c[:, 2] * d[:, 1] ** 2) + c[:, 1] * d[:, 0] * d[:, 1]
        alpha = (opacities[0, order] * torch.exp(-power)).clamp_max(0.999)
        kept = order[alpha >= 1 / 255]
        left = torch.cumprod(1 - alpha[alpha >= 1 / 255], 0)
        kept = kept[left > 1e-4]
        ids.append(kept)
        pixels.append(torch.full_like(kept, pixel))
    gaussian, pixel_ids = torch.cat(ids), torch.cat(pixels)
    color, alpha = gs.accumulate(
        means2d,
        conics,
        opacities,
        colors,
        gaussian,
        pixel_ids,
        torch.zeros_like(gaussian),
        case.width,
        case.height,
    )
    return color[0] + (1 - alpha[0]) * case.background.double(), alpha[0, ..., 0]


def off_centre(case: Case) -> Case:
    K = case.K.clone()
    K[0, 2], K[1, 2] = 6.0, 21.0
    return replace(case, K=K)


@pytest.mark.parametrize(
    "case",
    [
        scene("degree 3", 80, width=30, height=25, seed=90),
        scene("degree 1", 80, width=25, height=30, degree=1, seed=91),
        replace(scene("antialias", 60, width=25, height=20, degree=0, seed=92), antialias=True),
        off_centre(scene("principal point off centre", 60, width=30, height=25, degree=2, seed=93)),
        replace(
            scene("large, far off-axis", 30, width=25, height=20, degree=0, seed=94),
            log_scales=torch.full((30, 3), 0.3),
        ),
    ],
    ids=lambda c: c.name,
)
def test_image_is_gsplats(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """To 1e-9: gsplat's determinant a c - b^2 loses a few of float64's digits; its SH constants have 13 or more."""
    color, alpha = drawn_by_gsplat(case, monkeypatch)
    V, K = case.camera(torch.float64)
    p = reference.project(
        *case.groups(torch.float64),
        V,
        K,
        case.width,
        case.height,
        degree=case.degree,
        antialias=case.antialias,
    )
    bins = reference.bin(p, case.width, case.height)
    ours = reference.composite(p, bins, case.width, case.height, background=case.background.double())
    assert float(alpha.mean()) > 0.05
    assert float((ours[0] - color).abs().max()) < 1e-9
    assert float((ours[1] - alpha).abs().max()) < 1e-9

"""What the proofs of the median depth share: fields of a case, and which splats a pixel may show."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import (
    ALPHA_MAX,
    ALPHA_MIN,
    MEDIAN,
    NEAREST_HORIZON,
    TILE,
    Bins,
    Projected,
)
from tests.support.kernels.bounds import at_most
from tests.support.kernels.cases import Case
from tests.support.kernels.proof import EPS, record_error


def fields_of(case: Case) -> tuple[Projected, Bins, Tensor]:
    """Projected splats in float32, their lists by the definition, and tilts of some hundredths."""
    exact = case.project(case.groups(torch.float64), case.viewmat.double(), "reference")
    projected = Projected(*(field.detach().float() for field in exact))
    bins = ops.bin(
        Projected(*(field.double() for field in projected)), case.width, case.height, backend="reference"
    )
    random = torch.randn(len(projected.depths), 2, generator=torch.Generator().manual_seed(3))
    return projected, bins, 0.02 * random


def agrees(name: str, case: Case, depth: Tensor, projected: Projected, bins: Bins, tilts: Tensor) -> None:
    """Assert that every pixel shows one of the splats that the errors of alpha allow, at the depth of its plane."""
    exact = Projected(*(field.double() for field in projected))
    error = record_error(
        exact
    )  # infinite for needles whose conic has lost all digits: then any alpha is possible
    tilts = tilts.double()
    columns = -(-case.width // TILE)
    undecided = 0
    for tile in range(len(bins.offsets) - 1):
        ids = bins.ids[bins.offsets[tile] : bins.offsets[tile + 1]].long()
        top, left = tile // columns * TILE, tile % columns * TILE
        ys, xs = (
            torch.arange(top, min(top + TILE, case.height)),
            torch.arange(left, min(left + TILE, case.width)),
        )
        shown = depth[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1].double().reshape(-1)
        if not len(ids):
            assert (shown == 0).all()
            continue
        y, x = torch.meshgrid(ys + 0.5, xs + 0.5, indexing="ij")
        dx, dy = x.reshape(-1, 1) - exact.means2d[ids, 0], y.reshape(-1, 1) - exact.means2d[ids, 1]
        a, b, c = exact.conics[ids].unbind(1)
        raw = exact.opacities[ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        low = (raw * (1 - error[ids]).clamp_min(0.0)).nan_to_num(0.0)
        high = torch.minimum((raw * (1 + error[ids])).nan_to_num(torch.inf), exact.opacities[ids])
        least = torch.where(low >= ALPHA_MIN, low.clamp_max(ALPHA_MAX), 0.0)
        most = torch.where(high >= ALPHA_MIN, high.clamp_max(ALPHA_MAX), 0.0)
        rounding = 2 * EPS * torch.arange(1, len(ids) + 1)
        # A transmittance is between those with all alphas as large and as small as they may be.
        early = torch.cumprod(1 - most, 1) * (1 - rounding) <= MEDIAN
        late = torch.cumprod(1 - least, 1) * (1 + rounding) <= MEDIAN
        before = torch.cat([torch.zeros_like(late[:, :1]), late[:, :-1]], 1)
        possible = early & ~before & (most > 0)
        nearness = 1 - tilts[ids, 0] * dx - tilts[ids, 1] * dy
        terms = 1 + (tilts[ids, 0] * dx).abs() + (tilts[ids, 1] * dy).abs()
        terms = terms + (tilts[ids].abs() * exact.means2d[ids].abs()).sum(1)
        plane = torch.where(nearness > NEAREST_HORIZON, exact.depths[ids] / nearness, 0.0)
        # Four roundings of the terms, relative to what is left of them, and one of the quotient.
        allowed = EPS * plane * (4 * terms / nearness.clamp_min(NEAREST_HORIZON) + 2)
        off = torch.where(plane == 0, shown[:, None] * torch.inf, (shown[:, None] - plane).abs() / allowed)
        off = torch.where((plane == 0) & (shown[:, None] == 0), 0.0, off)
        off = torch.where(possible, off, torch.inf).amin(1)
        none = ~late[:, -1] & (shown == 0)
        at_most("median depth", name, torch.where(none, 0.0, off), 1.0)
        undecided += int((possible.sum(1) + (~late[:, -1]) > 1).sum())
    if not name.startswith(("pile", "long needles")):
        assert undecided < 0.05 * depth.numel()

"""What rounding the inputs does to images and gradients: the unit in which errors are counted.

Every input (parameters, camera, and for gradients the image's gradient) is moved at random by the unit roundoff in the
root mean square; what an output value then changes by, in the root mean square over some draws, is its condition number
times the unit roundoff. No algorithm that reads rounded inputs can be asked for less. Half an ulp of the output itself
is added, since it is stored. The lists are those of the exact scene, so that no draw changes an order.

A second unit adds what the engines' 2^x contributes by design: every alpha, at every pixel, moved by up to EXP2_ERROR.
A third adds the rounding of the backward pass's difference: what lies behind a splat is the final colour minus what was
blended so far, so that a splat's gradient gets the rounding of the whole pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from _studies.functions.tolerances import ALPHA_ERROR, U
from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Bins, Projected
from splatmill_worker.splat.motion import motion

from .roundings import TINY, inexact_exponential, rounded_remainders, rounded_up_or_down
from .scenes import GROUPS, Scene


@dataclass(frozen=True)
class Values:
    """Outputs of one scene: image [H,W,3], a gradient of each group's shape, and that to a motion [6], if any."""

    image: Tensor
    gradients: dict[str, Tensor]


@dataclass(frozen=True)
class Problem:
    """A scene with its exact outputs, and the change of each output that half an ulp of the inputs makes."""

    scene: Scene
    weights: Tensor  # [H,W,3] the image's gradient, 0 where undecided
    undecided: Tensor  # [H,W] pixels with an alpha or transmittance so near a threshold that rounding decides
    exact: Values
    unit: Values  # by rounding the inputs
    designed: Values  # by that and the error of 2^x
    explained: Values  # by both and the rounding of what lies behind a splat


def _projected(
    scene: Scene, backend: ops.Backend, dtype: torch.dtype
) -> tuple[list[Tensor], Tensor, Projected]:
    """The leaves of the five groups, the motion of the camera, and what both are projected to."""
    leaves = [x.requires_grad_() for x in scene.groups(dtype)]
    xi = torch.zeros(6, dtype=dtype, requires_grad=True)
    means, log_scales, quats, logit_opacities, sh = leaves
    viewmat, K = motion(xi) @ scene.viewmat.to(dtype), scene.K.to(dtype)
    p = ops.project(
        means, log_scales, quats, logit_opacities, sh, viewmat, K, scene.width, scene.height,
        degree=3, backend=backend,
    )  # fmt: skip
    return leaves, xi, p


def by_ops(
    scene: Scene, weights: Tensor, backend: ops.Backend, dtype: torch.dtype, bins: Bins | None = None
) -> tuple[Values, Projected, Bins]:
    """Project, bin (unless lists are given) and composite; the gradients of the image's weighted sum."""
    leaves, xi, p = _projected(scene, backend, dtype)
    w, h = scene.width, scene.height
    if bins is None:
        bins = ops.bin(p, w, h, backend=backend)
    color, _, _ = ops.composite(p, bins, w, h, backend=backend)
    slopes = torch.autograd.grad((color * weights.to(dtype)).sum(), [*leaves, xi])
    gradients = dict(zip((*GROUPS, "pose"), slopes, strict=True))
    return Values(color.detach(), gradients), Projected(*(x.detach() for x in p)), bins


def state(scene: Scene, draws: int, seed: int = 0, exponents: float = 0.0) -> Problem:
    """The exact outputs of a scene and their units, over `draws` changes of the inputs.

    exponents: log-scales and logits are moved as if they were at least this large. At 1, the rounding of exp's result
    is counted, which that of an argument near 0 does not contain.
    """
    g = torch.Generator().manual_seed(seed)
    h, w = scene.height, scene.width
    weights = torch.randn(h, w, 3, generator=g).double()

    def moved(x: Tensor) -> Tensor:
        return rounded_up_or_down(x, g)

    def project(x: Scene) -> Projected:
        with torch.no_grad():
            return ops.project(*x.arrays(), x.viewmat, x.K, w, h, degree=3, backend="reference")

    def changed_scene() -> Scene:
        variant = scene.mapped(moved)
        if not exponents:
            return variant

        def argument(x: Tensor) -> Tensor:
            return x + (moved(torch.ones_like(x)) - 1) * x.abs().clamp_min(exponents)

        return replace(
            variant, log_scales=argument(scene.log_scales), logit_opacities=argument(scene.logit_opacities)
        )

    changed = [changed_scene() for _ in range(draws)]
    at = project(scene)
    bins = ops.bin(at, w, h, backend="reference")
    others = [project(x) for x in changed]
    undecided = _undecided(at, others, _reached([at, *others], w, h), w, h)
    weights = weights * ~undecided[..., None]

    def outputs(x: Scene, d_color: Tensor) -> dict[str, Tensor]:
        values, _, _ = by_ops(x, d_color, "reference", torch.float64, bins)
        return {"image": values.image, **values.gradients}

    def spread(samples: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Mean square change of each output."""
        total = {k: torch.zeros_like(x) for k, x in exact.items()}
        for sample in samples:
            for k, value in sample.items():
                total[k] += (value - exact[k]) ** 2 / draws
        return total

    exact = outputs(scene, weights)
    by_inputs = spread(outputs(x, moved(weights)) for x in changed)

    # The other two roundings come after the projection, whose derivative is taken once for all draws.
    leaves, xi, projected = _projected(scene, "reference", torch.float64)
    fields = [x.detach().requires_grad_() for x in projected[:5]]

    def blended() -> Tensor:
        p = Projected._make([*fields, projected.extents])
        return ops.composite(p, bins, w, h, backend="reference")[0]

    def pulled(totals: list[Tensor]) -> list[dict[str, Tensor]]:
        """The gradients of every total to the leaves and the motion."""
        per_total = [torch.autograd.grad(x, fields, materialize_grads=True) for x in totals]
        stacked = [torch.stack(x) for x in zip(*per_total, strict=True)]
        pulled_back = torch.autograd.grad(
            projected[:5], [*leaves, xi], stacked, retain_graph=True, is_grads_batched=True
        )
        names = (*GROUPS, "pose")
        return [dict(zip(names, x, strict=True)) for x in zip(*pulled_back, strict=True)]

    with inexact_exponential(g):
        images = [blended() for _ in range(draws)]
    slopes = pulled([(x * weights).sum() for x in images])
    by_function = spread({"image": x.detach(), **k} for x, k in zip(images, slopes, strict=True))

    def remainder() -> Tensor:
        with rounded_remainders(torch.cat([weights, 0 * weights[..., :1]], 2), g) as terms:
            color = blended()
        return sum(terms, 0 * color.sum())

    by_difference = spread(
        {**exact, **{k: exact[k] + x for k, x in slope.items()}}
        for slope in pulled([remainder() for _ in range(draws)])
    )

    def unit(square: dict[str, Tensor]) -> Values:
        rounded = {k: torch.sqrt(square[k]) + U * x.abs() + TINY for k, x in exact.items()}
        image = rounded.pop("image")
        return Values(image, rounded)

    both = {k: x + by_function[k] for k, x in by_inputs.items()}
    image = exact.pop("image")
    values = Values(image, dict(exact))
    exact["image"] = image
    all_three = {k: x + by_difference[k] for k, x in both.items()}
    return Problem(scene, weights, undecided, values, unit(by_inputs), unit(both), unit(all_three))


SAFETY = 8.0
"""A decision is safe where its value is this many times its spread over the draws away from the threshold."""


def _reached(projected: list[Projected], width: int, height: int) -> Bins:
    """Lists of what reaches a tile in any of the scenes, front to back in the first."""
    lists = [ops.bin(p, width, height, backend="reference") for p in projected]
    ids, offsets = [], [0]
    for tile in range(len(lists[0].offsets) - 1):
        present = {i for x in lists for i in x.ids[x.offsets[tile] : x.offsets[tile + 1]].tolist()}
        every = torch.tensor(sorted(present), dtype=torch.int64)
        ids.append(every[torch.argsort(projected[0].depths[every], stable=True)])
        offsets.append(offsets[-1] + len(every))
    return Bins(torch.tensor(offsets), torch.cat(ids).to(torch.int32))


def _undecided(at: Projected, others: list[Projected], bins: Bins, width: int, height: int) -> Tensor:
    """Pixels [H,W] where a threshold (1/255, 0.999, or the transmittance's 1e-4) lies within reach of rounding."""
    undecided = torch.zeros(height, width, dtype=torch.bool)
    columns = -(-width // TILE)
    for tile in range(len(bins.offsets) - 1):
        ids = bins.ids[bins.offsets[tile] : bins.offsets[tile + 1]].long()
        if not len(ids):
            continue
        top, left = tile // columns * TILE, tile % columns * TILE
        ys, xs = torch.arange(top, min(top + TILE, height)), torch.arange(left, min(left + TILE, width))
        y, x = torch.meshgrid(ys + 0.5, xs + 0.5, indexing="ij")
        pixel = torch.stack([x.reshape(-1, 1), y.reshape(-1, 1)]).double()

        log_alphas = [_log_alpha(p, ids, pixel) for p in (at, *others)]
        exact = log_alphas[0]
        slack = ALPHA_ERROR + SAFETY * torch.stack([(a - exact).abs() for a in log_alphas[1:]]).amax(0)
        lasting = [_log_transmittance(a) for a in log_alphas]
        alpha = torch.exp(exact).clamp_max(ALPHA_MAX)
        lost = torch.cumsum(torch.where(exact >= LOG_CUT, ALPHA_ERROR * alpha / (1 - alpha), 0.0), 1)
        unsure = lost + SAFETY * torch.stack([(a - lasting[0]).abs() for a in lasting[1:]]).amax(0)
        # Beyond the end of a pixel nothing is decided any more.
        before = lasting[0] > LOG_END - unsure
        reached = torch.cat([torch.ones_like(before[:, :1]), before[:, :-1]], 1)
        near = (exact - LOG_CUT).abs() <= slack
        near |= (exact - LOG_FULL).abs() <= slack
        near |= (lasting[0] - LOG_END).abs() <= unsure
        undecided[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1] = (near & reached).any(1).reshape(len(ys), len(xs))
    return undecided


LOG_CUT, LOG_FULL, LOG_END = (
    float(torch.log(torch.tensor(x, dtype=torch.float64))) for x in (ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN)
)


def _log_alpha(p: Projected, ids: Tensor, pixel: Tensor) -> Tensor:
    """log of alpha before the clamp, [pixels, splats]."""
    d = pixel - p.means2d[ids].T[:, None]
    a, b, c = p.conics[ids].T[:, None]
    form: Tensor = 0.5 * (a * d[0] ** 2 + c * d[1] ** 2) + b * d[0] * d[1]
    return torch.log(p.opacities[ids].clamp_min(1e-300)) - form


def _log_transmittance(log_alpha: Tensor) -> Tensor:
    alpha = torch.exp(log_alpha).clamp_max(ALPHA_MAX)
    return torch.cumsum(torch.log1p(-torch.where(log_alpha >= LOG_CUT, alpha, 0.0)), 1)

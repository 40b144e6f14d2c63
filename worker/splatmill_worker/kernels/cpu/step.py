"""The training step on the CPU: a scene in the engine's layout, and the passes fused into one call."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels import checks
from splatmill_worker.kernels.records import PARAMETERS, TILE, PartOf, Rates, StepResult, Waves

from ..morton import morton_order
from . import blocks, engine
from .loss import PhotoStats, photo_stats

CLUSTER = 256
"""Gaussians of a cluster, as in clusters.hpp."""


class Visibility(NamedTuple):
    """What the last rendering counted.

    visible: Gaussians that reach a 4x4-pixel block of the image.
    pairs: (tile, Gaussian) pairs.
    """

    visible: int
    pairs: int


class Step:
    """Parameters, Adam moments and densification scores of one scene on the CPU, and the training step over them.

    Adam is dense: every step moves every Gaussian, those that were not in view by their moments. With `clustered`,
    steps leave out the clusters of 256 neighbours that cannot be in view; these make up for what they missed when they
    may be in view again, or are read. Not for use from two threads at once.

    Gaussians of a context are rendered with the others, and nothing moves them: they hide and are hidden, but they have
    no scores, no moments and no part in `count`, `parameters` or `moments`.

    threads: how many the passes use; results do not depend on it.
    clustered: whether steps leave out clusters that are not in view. To be changed before a `replace`.
    count: number of Gaussians, without those of the context.
    keep_scores: whether steps add to the densification scores.
    visibility: what the last rendering counted.
    pose_gradient: the camera's gradient of the last update; see `backward_update`.
    waves: what varies the colours over the Gaussians of later renderings, None for nothing. To be set again after a
        `replace`.
    wave_gradient: the loss's gradient [M, 6] to the values of the waves of the last `train` or `backward_update`.
    blocks, exp_avg, exp_avg_sq: parameters and moments, float32 [ceil(N/16), 59, 16] (`blocks`); with `clustered`, in
        an order of their own, and without the steps missed. Parameters of a context stand behind the others, from a
        block, or with `clustered` a cluster, of their own on.
    """

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        *,
        threads: int | None = None,
        clustered: bool = False,
        context: dict[str, Tensor] | None = None,
    ) -> None:
        """Take means [N,3], log_scales [N,3], quats [N,4], logit_opacities [N] and sh [N,16,3], float32 on the CPU.

        threads: None is the affinity mask's and OMP_NUM_THREADS' number.
        context: the same five tensors of the Gaussians that nothing moves, by name; None: there are none.

        Raises TypeError or ValueError that names the argument.
        """
        self.threads = threads or engine.default_threads()
        if self.threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self.clustered = clustered
        self.keep_scores = True
        self._frame = engine.Frame()
        self._image = torch.zeros(0)
        self._gradient = torch.zeros(0)
        self._size = (0, 0)
        self._degree = 0
        self.visibility = Visibility(0, 0)
        self.pose_gradient: Tensor | None = None
        self.waves: Waves | None = None
        self.wave_gradient: Tensor | None = None
        self._waved: int | None = None  # waves of the last rendering
        self._context: dict[str, Tensor] | None = None
        if context is not None and len(context["means"]):
            self._context = {name: context[name].detach() for name in blocks.FIRST}
            checks.gaussians(*self._context.values(), coefficients=16)
        self.replace(
            {
                "means": means,
                "log_scales": log_scales,
                "quats": quats,
                "logit_opacities": logit_opacities,
                "sh": sh,
            },
            None,
            None,
        )

    # ---- state

    def replace(self, params: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None) -> None:
        """Take other Gaussians, as after densification or a roll-back, with moments [N, 59] or zeros; zero the scores.

        params [N, ...] by group, as in the constructor. Raises TypeError or ValueError that names the argument.
        """
        ordered = {name: params[name] for name in blocks.FIRST}
        checks.gaussians(*ordered.values(), coefficients=16)
        count = len(ordered["means"])
        for name, moment in (("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
            if moment is not None:
                checks.tensor(name, moment, (count, PARAMETERS))
        self.count = count
        self._moved: int | None = None
        if self._context is None:
            self._rows, order = count, self._order_of(ordered["means"])
        else:
            unused = -count % (CLUSTER if self.clustered else blocks.LANES)
            ordered = {
                name: torch.cat(
                    [value.detach(), value.new_zeros(unused, *value.shape[1:]), self._context[name]]
                )
                for name, value in ordered.items()
            }
            self._rows, self._moved = len(ordered["means"]), (count + unused) // blocks.LANES
            order = self._order_with_context(ordered["means"], count, count + unused)
            exp_avg, exp_avg_sq = (
                None if moment is None else torch.cat([moment, moment.new_zeros(unused, PARAMETERS)])
                for moment in (exp_avg, exp_avg_sq)
            )
        self._order = order
        self.blocks = blocks.pack(ordered, self._rows, self.threads, order)
        for name, moment in (("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
            self.__dict__.pop(name, None)
            if moment is not None:
                own = None if order is None else order[: len(moment)]
                setattr(self, name, blocks.pack_rows(moment, self.threads, own))
        self._clusters = engine.Clusters(*self._state, self._rows, self.threads) if self.clustered else None
        self._scores = torch.zeros(3, len(self.blocks) * blocks.LANES)
        self._rendered = False

    def _order_of(self, means: Tensor) -> Tensor | None:
        return morton_order(means.detach().nan_to_num(0.0, 0.0, 0.0), cubic=True) if self.clustered else None

    def _order_with_context(self, means: Tensor, count: int, first: int) -> Tensor | None:
        """The order of `count` Gaussians, of the rows without a Gaussian before row `first`, and of the context."""
        free, context = self._order_of(means[:count]), self._order_of(means[first:])
        if free is None or context is None:
            return None
        return torch.cat([free, torch.arange(count, first), first + context])

    def parameters(self) -> dict[str, Tensor]:
        """Return copies of the parameters, [N, ...] each, under the names of the constructor."""
        self._settle()
        n = self.count
        shapes = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quats": (n, 4),
            "logit_opacities": (n,),
            "sh": (n, 16, 3),
        }
        sizes = {k: torch.Size(s) for k, s in shapes.items()}
        return blocks.unpack(self.blocks, sizes, n, self.threads, self._own_order)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Return copies of Adam's first and second moments, [N, 59] each; columns in the order of `records.GROUPS`."""
        self._settle()
        first, second = (
            blocks.unpack_rows(rows, self.count, self.threads, self._own_order)
            for rows in (self.exp_avg, self.exp_avg_sq)
        )
        return first, second

    @cached_property
    def exp_avg(self) -> Tensor:
        """The first moments: zeros, made when they are first used, since an engine that only renders needs none."""
        return blocks.empty(self._moving)

    @cached_property
    def exp_avg_sq(self) -> Tensor:
        """The second moments: zeros, made when they are first used."""
        return blocks.empty(self._moving)

    @property
    def _moving(self) -> int:
        """Number of the first rows, which have moments: all but those of the context."""
        return self._rows if self._moved is None else self._moved * blocks.LANES

    @property
    def _own_order(self) -> Tensor | None:
        """The order of the rows without those of the context."""
        return None if self._order is None else self._order[: self.count]

    @property
    def share_computed(self) -> float:
        """Share of the clusters that the last rendering computed; 1 without `clustered`."""
        return 1.0 if self._clusters is None else len(self._clusters.chosen) / max(1, self._clusters.count)

    @property
    def _state(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.blocks, self.exp_avg, self.exp_avg_sq

    def _settle(self) -> None:
        """Bring every Gaussian to where dense Adam has it."""
        if self._clusters is not None:
            self._clusters.settle(*self._state, self.threads)

    @property
    def logit_opacities(self) -> Tensor:
        """View [blocks, 16] of the logits of the opacities, to be written to between steps."""
        return self.blocks[:, blocks.FIRST["logit_opacities"], :]

    # Densification scores [N], views but with `clustered`, that add up over steps until `replace`.
    # The norm of the gradient is in NDC units (the image is 2 wide and 2 high), as published thresholds are.

    @property
    def plain_sum(self) -> Tensor:
        """Sum over views of |dL/d mean2d| in NDC units (Kerbl et al. 2023)."""
        return self._score(0)

    @property
    def visible_count(self) -> Tensor:
        """Number of views in which the Gaussian reached a 4x4-pixel block of the image."""
        return self._score(1)

    @property
    def max_extent(self) -> Tensor:
        """Largest half side, over views, of the box around the 1/255 ellipse, over half the image's longer side."""
        return self._score(2)

    def _score(self, number: int) -> Tensor:
        score = self._scores[number, : self._rows]
        if self._order is not None:
            score = torch.empty_like(score).index_copy_(0, self._order, score)
        return score[: self.count]

    # ---- the step

    def forward(
        self,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        *,
        degree: int,
        background: Tensor | None = None,
        antialias: bool = False,
        near: float = 0.01,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render color [H,W,3], alpha [H,W] and depth [H,W] = sum of weight times z.

        viewmat [4,4] world to camera, K [3,3] pixels, background [3] (None: black), float32. The images are views of
        buffers that the next call overwrites; do not write to them.
        """
        self._render(viewmat, K, width, height, degree, background, antialias, near, planes=5)
        inside = self._image[:, :height, :width]
        return inside[:3].permute(1, 2, 0), inside[3], inside[4]

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
        pose_gradient: bool = False,
    ) -> int:
        """Differentiate the last `forward` and move every Gaussian by Adam's step number `step`, from 1.

        d_color [H,W,3], d_alpha [H,W] and d_depth [H,W] are the loss's gradients to what `forward` returned; None
        counts as 0. Returns how many gradient values were refused as not finite. Raises RuntimeError without a
        `forward` since the last update.

        pose_gradient: also set `self.pose_gradient` (else None) to the camera's gradient, float32 [6]: that of the loss
        with the camera at exp(xi^) viewmat, xi = (rho, phi), at xi = 0. A point p in camera space then moves by rho +
        phi x p; rho is in world units, phi in radians. It need not be finite where gradient values were refused.
        """
        gradient = self._take_gradient(d_color, d_alpha, d_depth)
        return self._update(gradient, rates, step, pose_gradient)

    def gradients(
        self, d_color: Tensor, d_alpha: Tensor | None = None, d_depth: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the gradients of the last `forward` to the parameters, [N, ...] each, and change nothing."""
        gradient = self._take_gradient(d_color, d_alpha, d_depth)
        out = torch.empty_like(self.blocks)
        engine.gradients(self._frame, self.blocks, self._degree, self._image, gradient, out, self.threads)
        shapes = {
            name: torch.Size((self._rows, *value.shape[1:])) for name, value in self.parameters().items()
        }
        groups = blocks.unpack(out, shapes, self._rows, self.threads, self._order)
        return {name: value[: self.count] for name, value in groups.items()}

    def train(
        self,
        viewmat: Tensor,
        K: Tensor,
        photo: Tensor | None,
        *,
        degree: int,
        rates: Rates,
        step: int,
        background: Tensor | None = None,
        mask: Tensor | None = None,
        dssim_weight: float = 0.2,
        photo_stats: PhotoStats | None = None,
        antialias: bool = False,
        near: float = 0.01,
        pose_gradient: bool = False,
        part_of: PartOf | None = None,
    ) -> StepResult:
        """Take one step on one photo: render, L1 + D-SSIM, gradients, scores, Adam.

        photo uint8 [H,W,3] and mask [H,W], nonzero where a pixel is used; or photo_stats, which `loss.photo_stats`
        makes of both at the cost of the loss itself. step counts from 1. pose_gradient as in `backward_update`.
        part_of: the photo that this one is a part of: gradients and scores are then those that the part has in it.
        """
        stats = _stats(photo, mask) if photo_stats is None else photo_stats
        height, width = stats.pixels.shape[1], stats.width
        self._render(viewmat, K, width, height, degree, background, antialias, near, planes=3)
        l1, ssim = engine.loss(
            self._image,
            stats.pixels,
            stats.used,
            stats.mean,
            stats.variance,
            width,
            height,
            stats.weight,
            dssim_weight,
            self._gradient,
            self.threads,
        )
        if part_of is not None:
            self._gradient.mul_(stats.weight / part_of.used)
        refused = self._update(self._gradient, rates, step, pose_gradient, part_of)
        total = (1 - dssim_weight) * l1 + dssim_weight * (1 - ssim)
        return StepResult(total, l1, ssim, *self.visibility, refused)

    def _render(
        self,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        background: Tensor | None,
        antialias: bool,
        near: float,
        planes: int,
    ) -> None:
        checks.camera(viewmat, K, width, height, degree, near, background)
        self._rendered = False  # until it is: an error leaves the frame's lists half made
        if self.waves is not None:
            if self._context is not None:
                raise ValueError("waves: they are for Gaussians without a context; leave out one of the two")
            checks.waves(self.waves, self.count)
        shape = (planes, -(-height // TILE) * TILE, -(-width // TILE) * TILE)
        if self._image.shape != shape:
            self._image, self._gradient = torch.zeros(shape), torch.zeros(shape)
        camera = engine.Camera(viewmat.contiguous(), K.contiguous(), width, height, near, antialias)
        color = (0.0, 0.0, 0.0) if background is None else tuple(background.tolist())
        if self._clusters is not None:
            self._clusters.choose(*self._state, camera, self.threads)
        numbers = engine.render(
            self._frame,
            self.blocks,
            self._rows,
            degree,
            camera,
            color,
            self._image,
            self.threads,
            self._clusters,
            *(() if self.waves is None else (x.detach().contiguous() for x in self.waves)),
        )
        self._waved = None if self.waves is None else len(self.waves.values)
        self.visibility = Visibility(*numbers)
        self._degree, self._size, self._rendered = degree, (height, width), True

    def _take_gradient(self, d_color: Tensor, d_alpha: Tensor | None, d_depth: Tensor | None) -> Tensor:
        if not self._rendered or len(self._image) != 5:
            raise RuntimeError(
                "There is nothing to differentiate; call forward first, and again after every update, train or replace."
            )
        height, width = self._size
        checks.tensor("d_color", d_color, (height, width, 3), contiguous=False)
        planes = 3 if d_alpha is None and d_depth is None else 5
        gradient = self._gradient[:planes]
        gradient[:3, :height, :width] = d_color.permute(2, 0, 1)
        for i, (name, d) in enumerate((("d_alpha", d_alpha), ("d_depth", d_depth)), 3):
            if d is not None:
                checks.tensor(name, d, (height, width), contiguous=False)
                gradient[i, :height, :width] = d
            elif planes == 5:
                gradient[i].zero_()
        return gradient

    def _update(
        self,
        gradient: Tensor,
        rates: Rates,
        step: int,
        pose_gradient: bool,
        part_of: PartOf | None = None,
    ) -> int:
        if step < 1:
            raise ValueError(f"step: counts from 1, got {step}")
        if pose_gradient and self._context is not None:
            raise ValueError("pose_gradient: a context has no part in it; leave out one of the two")
        self.pose_gradient = torch.empty(6) if pose_gradient else None
        self.wave_gradient = None if self._waved is None else torch.zeros(self._waved, 6)
        refused: int = engine.update(
            self._frame,
            self.blocks,
            self.exp_avg,
            self.exp_avg_sq,
            self._degree,
            self._image,
            gradient,
            rates.rows(),
            rates.beta2,
            step,
            self._scores if self.keep_scores else None,
            self.threads,
            self.pose_gradient,
            self._clusters,
            self.wave_gradient,
            self._moved,
            None if part_of is None else (part_of.width, part_of.height),
        )
        self._rendered = False  # the rendering shows the Gaussians before they moved
        return refused


def _stats(photo: Tensor | None, mask: Tensor | None) -> PhotoStats:
    if photo is None:
        raise ValueError("photo: expected a photo, or photo_stats made of it, got neither")
    checks.tensor("photo", photo, (None, None, 3), dtype=torch.uint8, contiguous=False)
    if mask is not None:
        checks.tensor("mask", mask, tuple(photo.shape[:2]), dtype=None, contiguous=False)
    return photo_stats(photo, mask=mask)

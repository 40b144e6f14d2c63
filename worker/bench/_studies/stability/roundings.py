"""The roundings whose effect is the unit of an error, put into the definition in float64 at random.

Not for use from two threads at once: all but the first change a module of the reference for the length of a block.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from _studies.functions.tolerances import EXP2_ERROR
from _studies.functions.tolerances import U as U  # the unit of what is below: others take it from here
from splatmill_worker.kernels.records import Projected

TINY = 2.0**-126
"""Smallest normal float32; what is smaller counts as 0 in the engines."""


def even(x: Tensor, g: torch.Generator) -> Tensor:
    """Uniform in [-1, 1], of the shape of x."""
    return 2 * torch.rand(x.shape, generator=g, dtype=torch.float64) - 1


def rounded_up_or_down(x: Tensor, g: torch.Generator) -> Tensor:
    """x with every value moved at random, by the unit roundoff in the root mean square."""
    return x * (1 + math.sqrt(3) * U * even(x, g))


@contextmanager
def inexact_exponential(g: torch.Generator, sign: float = 0.0) -> Iterator[None]:
    """Let the definition blend with alphas that are off by up to EXP2_ERROR; by all of it, with a sign, where given."""
    definition: Any = importlib.import_module("splatmill_worker.kernels.reference.composite")

    class Inexact:
        """torch, but for exp."""

        def __getattr__(self, name: str) -> Any:
            return getattr(torch, name)

        def exp(self, x: Tensor) -> Tensor:
            return torch.exp(x) * (1 + EXP2_ERROR * (sign or even(x, g)))

    definition.torch = Inexact()
    try:
        yield
    finally:
        definition.torch = torch


@contextmanager
def rounded_windows(g: torch.Generator, common: bool) -> Iterator[None]:
    """Let the definition's loss work with windowed moments that are off by the roundoff, in the root mean square.

    A window is 22 products and sums; the roundings of the first ones are of terms that are small beside the result.
    common: by the same share everywhere, as in an image of one colour, where every window rounds alike.
    """
    definition: Any = importlib.import_module("splatmill_worker.kernels.reference.loss")
    plain = definition._window

    def rounded(image: Tensor) -> Tensor:
        exact: Tensor = plain(image)
        share = torch.ones(1, dtype=torch.float64) if common else torch.ones_like(exact)
        return exact * rounded_up_or_down(share, g)

    definition._window = rounded
    try:
        yield
    finally:
        definition._window = plain


@contextmanager
def rounded_remainders(
    weights: Tensor, g: torch.Generator, beyond: Tensor | None = None
) -> Iterator[list[Tensor]]:
    """Yield a list of terms, one for each tile composited in the block, whose gradient is a draw of the error that the
    backward pass has by rounding what lies behind each splat.

    weights [H,W,4]: the gradient of colour and depth. beyond [H,W]: that of the transmittance left.

    With d the image's gradient, w a splat's weight and c its colour, the backward pass starts from d C and takes w d c
    off it, splat by splat: each result is off by the roundoff times its size, and all that follow are too. A splat's
    gradient to log alpha has the term -alpha / (1 - alpha) times that.
    """
    definition: Any = importlib.import_module("splatmill_worker.kernels.reference.composite")
    plain = definition._weights
    terms: list[Tensor] = []

    def watched(p: Projected, ids: Tensor, left: int, top: int, w: int, h: int, soft_cut: bool) -> Tensor:
        shares: Tensor = plain(p, ids, left, top, w, h, soft_cut)
        if not len(ids):
            return shares
        d = weights[top : top + h, left : left + w].reshape(-1, 4)
        before = 1 - torch.cat([torch.zeros_like(shares[:, :1]), shares.cumsum(1)[:, :-1]], 1)
        with torch.no_grad():
            payload = torch.cat([p.colors[ids], p.depths[ids, None]], 1)
            last = 1 - shares.sum(1, keepdim=True)
            rest = torch.zeros_like(last)
            if beyond is not None:
                rest = beyond[top : top + h, left : left + w].reshape(-1, 1) * last
            gain = shares * (d @ payload.T)
            behind = gain.sum(1, keepdim=True) - gain.cumsum(1) + rest
            start = ((shares @ payload) * d).abs().sum(1, keepdim=True) + rest.abs()
            noise = torch.randn(*gain.shape, generator=g, dtype=torch.float64)
            first = torch.randn(*start.shape, generator=g, dtype=torch.float64)
            off = U * (first * start + (noise * behind.abs() * (gain != 0)).cumsum(1))
            alpha = shares / before
            slope = torch.where(shares > 0, off * alpha / (1 - alpha), 0.0)
        log_alpha = torch.log(torch.where(shares > 0, shares / before, 1.0))
        terms.append((slope * log_alpha).sum())
        return shares

    definition._weights = watched
    try:
        yield terms
    finally:
        definition._weights = plain

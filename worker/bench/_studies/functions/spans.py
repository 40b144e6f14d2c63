"""The functions of the CPU kernels, and the arguments at which their errors are counted.

Floats are numbered in order: `place` is 0 at 0.0, 1 at the smallest denormal, -1 at -0.0, and so on up to both
infinities. A range of places is every float between two values.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

BINS = 256
"""Parts of a span, of which each has its largest error in the rows, for the figure."""


@dataclass(frozen=True)
class Span:
    """Every float in one or two intervals, ends included."""

    label: str
    intervals: tuple[tuple[float, float], ...]

    def parts(self, count: int) -> list[tuple[int, int]]:
        """About `count` ranges [first, end) of places, equally wide by value, that together are the span, in order."""
        ranges = []
        for low, high in self.intervals:
            n = count // len(self.intervals)
            inner = [place(x) for x in np.linspace(low, high, n + 1)[1:-1]]
            edges = [place(low), *inner, place(high) + 1]
            ranges += [(a, b) for a, b in pairwise(edges) if a < b]
        return ranges

    @property
    def count(self) -> int:
        """The number of floats."""
        return sum(place(high) + 1 - place(low) for low, high in self.intervals)


@dataclass(frozen=True)
class Octaves:
    """The other octaves of a function: 4^k x for k from `first` to `last` has the result of x times 2^(k power)."""

    first: int
    last: int
    power: int

    @property
    def label(self) -> str:
        return f"[2^{2 * self.first}, 2^{2 * self.last + 2})"


@dataclass(frozen=True)
class Function:
    """A function of math.hpp or simd.hpp, and all arguments of it that occur: a span, and any octaves beside it."""

    name: str
    exact: str  # what it approximates
    header: str
    used_for: str
    span: Span
    octaves: Octaves | None = None


TWO_OCTAVES = Span("[1, 4)", ((1.0, float(np.nextafter(np.float32(4), np.float32(0)))),))
LEAST_ALPHA = float(np.float32(1 / 255))
LOG2_LEAST_ALPHA = float(np.float32(-7.994353436858858))
NEAR_0 = 2.0**-30
"""Nearer to 0, where half of all floats are, e^x and 2^x have one and the same result: every sum rounds x away."""

FUNCTIONS = (
    # Any log-scale or logit: the function itself holds it within these limits.
    Function(
        "exp", "e^x", "math.hpp", "scales, opacities", Span("[-87, 88]", ((-87.0, -NEAR_0), (NEAR_0, 88.0)))
    ),
    # An opacity, which is held above 1/255.
    Function("log2", "log2 x", "math.hpp", "opacity to level and extents", Span("[1/255, 1]", ((LEAST_ALPHA, 1.0),))),
    # log2 of an alpha of at least 1/255. It cannot exceed log2 of the opacity, which is at most 0.
    Function(
        "exp2_of_alpha", "2^x", "math.hpp", "alpha of every pixel",
        Span("[log2(1/255), 0]", ((LOG2_LEAST_ALPHA, -NEAR_0),)),
    ),
    # From 1e-15 (Adam's epsilon) up; in compositing 1 - alpha, from 0.001 to 1. Estimates near 2^-126 are flushed to 0.
    Function(
        "reciprocal", "1/x", "simd.hpp", "1 - alpha in the backward pass, SSIM, Adam", TWO_OCTAVES, Octaves(-63, 61, -2)
    ),
    # All positive normal floats.
    Function("reciprocal_sqrt", "1/sqrt x", "simd.hpp", "Adam", TWO_OCTAVES, Octaves(-63, 63, -1)),
    Function("sqrt", "sqrt x", "simd.hpp", "norms, the conic's factor, extents", TWO_OCTAVES, Octaves(-63, 63, 1)),
)  # fmt: skip


def place(x: float) -> int:
    """The number of a float32 value in order."""
    return place_of(int(np.float32(x).view(np.uint32)))


def place_of(bits: int) -> int:
    """The place of the float with these bits."""
    return bits if bits < 2**31 else 2**31 - 1 - bits


def value(at: int) -> float:
    """The float at a place."""
    return float(np.uint32(bits_at(at)).view(np.float32))


def bits_at(at: int) -> int:
    """The bits of the float at a place."""
    return at if at >= 0 else 2**31 - 1 - at


def runs(first: int, end: int, stride: int) -> Iterator[tuple[int, int]]:
    """The floats at places first, first + stride, ... below end, as runs of bits `stride` apart: (lowest, how many)."""
    below = range(first, min(end, 0), stride)
    if len(below):
        yield bits_at(below[-1]), len(below)
    above = range(first - (min(first, 0) // stride) * stride, end, stride)
    if len(above):
        yield above[0], len(above)

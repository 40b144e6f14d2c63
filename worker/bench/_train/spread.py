"""Median and spread over seeds, and when a curve reaches a level."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass

from _rows import Row


@dataclass(frozen=True)
class Spread:
    """Median, least and largest of `count` values."""

    median: float
    least: float
    largest: float
    count: int

    @staticmethod
    def of(values: Iterable[float]) -> Spread:
        """Median and range of at least one value."""
        known = list(values)
        return Spread(statistics.median(known), min(known), max(known), len(known))

    def text(self, digits: int, *, signed: bool = False) -> str:
        """`31.42 (31.38 to 31.50)`; a single value stands alone."""
        sign = "+" if signed else ""
        median = f"{self.median:{sign}.{digits}f}"
        if self.count == 1:
            return median
        return f"{median} ({self.least:{sign}.{digits}f} to {self.largest:{sign}.{digits}f})"


def seconds_to(curve: Iterable[Row], psnr: float) -> float | None:
    """Training seconds at which a curve first reaches `psnr` dB, by linear interpolation.

    None where it never does. Where the first point is already above, its seconds are an upper bound.
    """
    before: Row | None = None
    for point in curve:
        if point["psnr"] is None:
            continue
        if point["psnr"] >= psnr:
            if before is None:
                return float(point["seconds"])
            share = (psnr - before["psnr"]) / (point["psnr"] - before["psnr"])
            return float(before["seconds"] + share * (point["seconds"] - before["seconds"]))
        before = point
    return None

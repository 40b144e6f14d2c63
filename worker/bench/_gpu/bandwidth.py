"""What the card's memory moves in a second: the unit of every floor."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from _rows import Row

from .timing import Place


def measure(place: Place) -> Iterator[Row]:
    """Copy, fill and sum of arrays that no cache holds, in bytes read and written."""
    count = 2**8 if place.dry else 2**28  # floats: 1 GiB
    source = torch.ones(count, device=place.device)
    target = torch.empty_like(source)
    works = {
        "copy": (lambda: target.copy_(source), 8 * count),
        "fill": (lambda: target.zero_(), 4 * count),
        "sum": (lambda: source.sum(), 4 * count),
    }
    for name, (work, moved) in works.items():
        ms = place.median_ms(work)
        rate = None if ms is None else moved / ms * 1e3
        yield {"access": name, "bytes": moved, "ms": ms, "bytes_per_second": rate}

"""The record of a projected Gaussian, which the passes gather by index, and the record of its gradient.

A record is one row, because a gather pays by the 32-byte sector: 12 floats are two sectors, and in six separate arrays
they would be six or more.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..records import Projected
from .constant import constant

WIDTH = 12
"""Floats of a record: the fields of `Projected`, in their order."""

GRADIENT_WIDTH = 16
"""Floats of a gradient record: the gradient of a record's first ten floats, and padding to 64 bytes."""

# Places in a record, and of the first ten also in a gradient record, as kernels read them.
MEAN_X, MEAN_Y = constant(0), constant(1)
CONIC_A, CONIC_B, CONIC_C = constant(2), constant(3), constant(4)
OPACITY = constant(5)
RED, GREEN, BLUE = constant(6), constant(7), constant(8)
DEPTH = constant(9)
EXTENT_X, EXTENT_Y = constant(10), constant(11)
DIFFERENTIABLE = constant(10)  # how many of the first places have a gradient
STRIDE, GRADIENT_STRIDE = constant(WIDTH), constant(GRADIENT_WIDTH)


def fields(record: Tensor) -> Projected:
    """Return views of records [N, 12], or of gradient records [N, 16], as the fields of `Projected`.

    The extents of a gradient record are padding.
    """
    return Projected(
        means2d=record[:, 0:2],
        conics=record[:, 2:5],
        opacities=record[:, 5],
        colors=record[:, 6:9],
        depths=record[:, 9],
        extents=record[:, 10:12],
    )


def visible(records: Tensor) -> Tensor:
    """Return which of records [N, 12] are not culled, as bool [N]."""
    return fields(records).extents[:, 0] > 0


def pack(projected: Projected) -> Tensor:
    """Return the records [N, 12] float32 behind `projected`, without a copy when its fields are views of them."""
    first = projected.means2d
    if first.dtype == torch.float32 and first.stride() == (WIDTH, 1):
        record = first.as_strided((first.shape[0], WIDTH), (WIDTH, 1))
        views = fields(record) if _covers(first) else None
        if views is not None and all(
            a.data_ptr() == b.data_ptr() and a.stride() == b.stride()
            for a, b in zip(views, projected, strict=True)
        ):
            return record
    columns = [x.detach().float() if x.dim() == 2 else x.detach().float()[:, None] for x in projected]
    return torch.cat(columns, 1)


def _covers(first: Tensor) -> bool:
    """Whether the storage holds whole records from where `first` begins."""
    room = first.untyped_storage().nbytes() // 4 - first.storage_offset()
    return room >= first.shape[0] * WIDTH

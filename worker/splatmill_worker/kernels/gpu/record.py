"""The 48-byte record of a projected Gaussian that the kernels gather, and its gradient's 64-byte
counterpart.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..records import Projected

# mean x, y | conic a, b, c | opacity | colour r, g, b | depth | extent x, y. Together, because compositing
# gathers by index and pays by the 32-byte sector: one record is two sectors, six separate arrays would be at
# least six.
WIDTH = 12
# The gradient of the first ten, then sum |d mean x|, sum |d mean y|, and padding to 64 bytes.
GRADIENT_WIDTH = 16


def fields(record: Tensor) -> Projected:
    """Views of a record [N, 12] as the fields of `Projected`."""
    return Projected(
        record[:, 0:2], record[:, 2:5], record[:, 5], record[:, 6:9], record[:, 9], record[:, 10:12]
    )


def pack(projected: Projected) -> Tensor:
    """The record [N, 12] float32 behind `projected`, without a copy when its fields are views of one."""
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

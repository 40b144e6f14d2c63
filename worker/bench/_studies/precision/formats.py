"""The storage formats of `storage.hpp` in torch: from float32 blocks to what a variant's kernels hold, and back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.cpu.blocks import empty

BYTES = {
    "Float32": 4,
    "BFloat16": 2,
    "BFloat16Stochastic": 2,
    "BFloat16Compensated": 3,
    "Float16": 2,
    "Float16Stochastic": 2,
}
"""Of one value."""

TYPES = {"BFloat16": torch.bfloat16, "BFloat16Stochastic": torch.bfloat16, "Float16": torch.float16,
         "Float16Stochastic": torch.float16}  # fmt: skip


@dataclass(frozen=True)
class Narrow:
    """Blocks [n, rows, 16] whose rows from `first` on are held in `format`, and the others in float32."""

    format: str
    first: int

    def stored(self, blocks: Tensor) -> Tensor:
        """The blocks as a variant holds them: packed one behind the other, at the front of as many float32."""
        parts = [_bytes(blocks[:, : self.first]), narrowed(blocks[:, self.first :], self.format)]
        packed = torch.cat([part.flatten(1) for part in parts], 1).flatten()
        room = empty(blocks.shape[0] * blocks.shape[2])  # backed by huge pages, as what it is compared with
        room.view(torch.uint8).view(-1)[: len(packed)] = packed
        return room

    def restored(self, room: Tensor) -> Tensor:
        """The float32 blocks of what `stored` returned, or of what the kernels made of it."""
        count, rows, lanes = room.shape
        wide, narrow = 4 * self.first * lanes, BYTES[self.format] * (rows - self.first) * lanes
        packed = room.view(torch.uint8).view(-1)[: count * (wide + narrow)].reshape(count, wide + narrow)
        first = packed[:, :wide].contiguous().view(torch.float32).view(count, self.first, lanes)
        rest = packed[:, wide:].contiguous().view(count, rows - self.first, BYTES[self.format] * lanes)
        return torch.cat([first, widened(rest, self.format)], 1)


def narrowed(rows: Tensor, format: str) -> Tensor:
    """Bytes [..., 16 BYTES] of float32 rows [..., 16], rounded to nearest."""
    if format != "BFloat16Compensated":
        return _bytes(rows.to(TYPES[format]))
    bits = rows.contiguous().view(torch.int32) + 0x80
    return torch.cat([_bytes((bits >> 16).to(torch.int16)), ((bits >> 8) & 0xFF).to(torch.uint8)], -1)


def widened(rows: Tensor, format: str) -> Tensor:
    """Float32 rows [..., 16] of bytes [..., 16 BYTES]."""
    if format != "BFloat16Compensated":
        return rows.contiguous().view(TYPES[format]).float()
    high = rows[..., :32].contiguous().view(torch.int16).to(torch.int32)
    return ((high << 16) | (rows[..., 32:].to(torch.int32) << 8)).view(torch.float32)


def _bytes(x: Tensor) -> Tensor:
    return x.contiguous().view(torch.uint8)

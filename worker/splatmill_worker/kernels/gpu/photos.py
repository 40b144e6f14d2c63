"""Photos on the device: copied once, laid over a background there, with what the loss needs of them alone kept."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ..reference.loss import PhotoStats
from .launch.argument import Bytes, Floats, Int
from .loss import photo_stats
from .transfers.transfer import to_device

STATS_BYTES = 24
"""Bytes of a pixel's statistics: mean and variance of three channels, float32."""

BLOCK = 256
"""Pixels per program."""


@triton.jit
def over_kernel(
    photo: Bytes, alpha: Bytes, background: Floats, out: Bytes, pixels: Int,
    BACKGROUND: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The photo [H, W, 3] with its alpha [H, W] over a background [3] in 0 to 1, or over black, rounded to 8 bits."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = p < pixels
    cover = tl.load(alpha + p, mask=here, other=0).to(tl.float32) / 255.0
    for channel in tl.static_range(3):
        value = tl.load(photo + p * 3 + channel, mask=here, other=0).to(tl.float32) * cover
        if BACKGROUND:
            value += (1.0 - cover) * (255.0 * tl.load(background + channel))
        tl.store(out + p * 3 + channel, (value + 0.5).to(tl.int32).to(tl.uint8), mask=here)


def over(photo: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
    """Return the photo uint8 [H, W, 3] with its alpha uint8 [H, W] over a background [3] on the device, or black."""
    out = torch.empty_like(photo)
    pixels = alpha.numel()
    over_kernel[(triton.cdiv(pixels, BLOCK),)](
        photo, alpha, background, out, pixels, BACKGROUND=background is not None, BLOCK=BLOCK
    )
    return out


@dataclass(frozen=True)
class Picture:
    """One photo as a step compares an image with it, on the device.

    pixels: uint8 [H, W, 3].
    mask: uint8 [H, W], nonzero where a pixel is used; None where all are.
    count: float32 [], number of pixels used.
    stats: the loss's part that depends on photo and mask alone; None where it is not kept.
    """

    pixels: Tensor
    mask: Tensor | None
    count: Tensor
    stats: PhotoStats | None


@dataclass(frozen=True)
class _Kept:
    """Statistics of a photo, and the mask that they were computed under."""

    mask: weakref.ReferenceType[Tensor] | None
    stats: PhotoStats

    def under(self, mask: Tensor | None) -> bool:
        """Whether they are those under this mask."""
        return self.mask is None if mask is None else self.mask is not None and self.mask() is mask


class Photos:
    """The photos and masks of one scene on its device, each kept for as long as the caller keeps its tensor.

    The caller must not write into a tensor that was given. room: bytes for the statistics of photos; those of further
    photos are computed at every visit.
    """

    def __init__(self, where: torch.device, room: int) -> None:
        self._where, self._room = where, room
        self._copies: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
        self._masks: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
        self._kept: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
        self._counts: dict[int, Tensor] = {}

    def here(self, tensor: Tensor) -> Tensor:
        """Return the tensor on this device, copied at the first call."""
        if tensor.device == self._where:
            return tensor.contiguous()
        held = self._copies.get(tensor)
        if held is None:
            held = to_device(tensor, self._where).contiguous()
            self._copies[tensor] = held
        assert isinstance(held, Tensor)
        return held

    def picture(
        self, photo: Tensor, alpha: Tensor | None, mask: Tensor | None, background: Tensor | None
    ) -> Picture:
        """Return the photo uint8 [H, W, 3] over a background [3] on the device where it has alpha uint8 [H, W].

        Statistics of transparent photos are not kept, since they change with the background.
        """
        pixels = self.here(photo)
        used, count = self._used(mask, photo.shape[0] * photo.shape[1])
        if alpha is not None:
            return Picture(over(pixels, self.here(alpha), background), used, count, None)
        return Picture(pixels, used, count, self._stats(photo, pixels, mask, used))

    def forget_stats(self) -> None:
        """Free the statistics of all photos, for good: there is too little memory."""
        self._room = 0
        self._kept.clear()

    def _used(self, mask: Tensor | None, pixels: int) -> tuple[Tensor | None, Tensor]:
        if mask is None:
            if pixels not in self._counts:
                self._counts[pixels] = torch.full((), float(pixels), device=self._where)
            return None, self._counts[pixels]
        held = self._masks.get(mask)
        if held is None:
            used = (to_device(mask, self._where) != 0).to(torch.uint8).contiguous()
            held = used, torch.count_nonzero(used).to(torch.float32)
            self._masks[mask] = held
        assert isinstance(held, tuple)
        return held

    def _stats(
        self, photo: Tensor, pixels: Tensor, mask: Tensor | None, used: Tensor | None
    ) -> PhotoStats | None:
        kept = self._kept.get(photo)
        if isinstance(kept, _Kept) and kept.under(mask):
            return kept.stats
        self._kept.pop(photo, None)
        held = sum(STATS_BYTES * other.stats.mean[..., 0].numel() for other in self._kept.values())
        if held + STATS_BYTES * pixels[..., 0].numel() > self._room:
            return None
        stats = photo_stats(pixels, mask=used)
        self._kept[photo] = _Kept(None if mask is None else weakref.ref(mask), stats)
        return stats

"""What a file of Gaussians says, whatever its format, and which Gaussians files hold."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.splat.gaussians import Gaussians

Offset = tuple[float, float, float]

NO_OFFSET: Offset = (0.0, 0.0, 0.0)

MIN_OPACITY = 1.0 / 255.0
"""Gaussians of less opacity are not written: they cannot change an 8-bit image."""

OPAQUE = 16.0
"""Logit of the largest opacity: 1 - 1e-7, the last one under 1 in float32."""


@dataclass(frozen=True)
class Contents:
    """The model in a file, in the frame of the standard `.ply`: x to the right, y down, z to the front.

    gaussians: float32, rows with a non-finite value left out.
    offset: world = file + offset. Export subtracts it where float32 could not hold the coordinates of the world.
    antialiased: whether the model was trained with the low-pass filter of Mip-Splatting (Yu et al. 2024); None where
        the file does not say.
    notes: sentences about what is read otherwise than it stands in the file, or not at all.
    """

    gaussians: Gaussians
    offset: Offset = NO_OFFSET
    antialiased: bool | None = None
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(
        gaussians: Gaussians,
        offset: Offset = NO_OFFSET,
        antialiased: bool | None = None,
        notes: tuple[str, ...] = (),
    ) -> Contents:
        """The contents without the rows of a file in which a value is not finite, or a quaternion has no direction."""
        keep = gaussians.finite()
        lost = gaussians.count - int(keep.sum())
        if lost:
            gaussians = gaussians.select(keep)
        return Contents(gaussians, offset, antialiased, (*notes, *left_out(lost, len(keep))))


def left_out(lost: int, count: int) -> tuple[str, ...]:
    """The note on rows that are left out, if there are any."""
    unfit = "Gaussians with a value that is not finite, or a quaternion of zeros, are left out"
    return (f"{unfit}: {lost} of {count}.",) if lost else ()


def visible(gaussians: Gaussians) -> Gaussians:
    """The rows that a file holds, on the CPU as float32: all finite, and of MIN_OPACITY or more."""
    gaussians = on_cpu(gaussians)
    return gaussians.select(visible_rows(gaussians))


def on_cpu(gaussians: Gaussians) -> Gaussians:
    """The Gaussians as float32 on the CPU, without gradients; a copy where they are not."""
    return gaussians.map(lambda value: value.detach().to("cpu", torch.float32))


def visible_rows(gaussians: Gaussians) -> Tensor:
    """bool [N]: the rows that a file holds, of float32 on the CPU."""
    return gaussians.finite() & (torch.sigmoid(gaussians.logit_opacities) >= MIN_OPACITY)


def gathered(count: int, degree: int, pieces: Iterable[Gaussians]) -> Gaussians:
    """The rows of pieces of float32, one after the other. A piece is copied, and freed where nothing else holds it.

    count: rows of all pieces at most. degree: that of the result.
    """
    shapes = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "logit_opacities": (),
        "sh": ((degree + 1) ** 2, 3),
    }
    whole = Gaussians(**{name: torch.empty(count, *shape) for name, shape in shapes.items()})
    end = 0
    for piece in pieces:
        first, end = end, end + piece.count
        for target, values in zip(whole, piece.padded(degree), strict=True):
            # By NumPy: of small pieces, torch's threads would take longer to wait for each other than to copy.
            target[first:end].numpy()[...] = values.numpy()
        del piece, values  # before the next is made
    return whole.select(slice(end))


def logits(opacities: Tensor) -> Tensor:
    """Logits of opacities from 0 to 1, both of which formats of 8 bits contain, up to OPAQUE in size."""
    return torch.logit(opacities).clamp(-OPAQUE, OPAQUE)


def unit(quats: Tensor) -> Tensor:
    """The quaternions [N, 4] at a norm of 1, computed in float64 because a norm may leave the range of float32."""
    return torch.nn.functional.normalize(quats.double(), dim=1, eps=0.0).float()

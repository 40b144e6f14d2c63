"""Checks of arguments, made before any kernel reads them. Every error names the argument."""

from __future__ import annotations

import torch
from torch import Tensor

from .records import Waves

LARGEST_SIDE = 32768
"""Largest width or height of an image in pixels."""


def tensor(
    name: str,
    value: object,
    shape: tuple[int | None, ...],
    *,
    dtype: torch.dtype | None = torch.float32,
    device: str = "cpu",
    contiguous: bool = False,
) -> None:
    """Raise TypeError or ValueError unless value is a tensor of this shape, dtype and device.

    shape: a side of None may have any length. dtype: None admits any. device: its type, "cpu" or "cuda".
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}")
    sides = "[" + ", ".join("*" if n is None else str(n) for n in shape) + "]"
    if value.dim() != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, value.shape, strict=True)
    ):
        raise ValueError(f"{name}: expected shape {sides}, got {list(value.shape)}")
    if dtype is not None and value.dtype != dtype:
        raise TypeError(f"{name}: expected {dtype}, got {value.dtype}")
    if value.device.type != device:
        raise ValueError(f"{name}: expected a tensor on {device}, got one on {value.device}")
    if contiguous and not value.is_contiguous():
        raise ValueError(f"{name}: expected a contiguous tensor, got strides {value.stride()}")


def gaussians(
    means: object,
    log_scales: object,
    quats: object,
    logit_opacities: object,
    sh: object,
    *,
    coefficients: int | None = None,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> None:
    """Check the five parameter groups of one scene: they have as many rows as means, fewer than 2^31."""
    tensor("means", means, (None, 3), dtype=dtype, device=device)
    assert isinstance(means, Tensor)
    n = len(means)
    if n >= 2**31:
        raise ValueError(f"means: expected at most 2147483647 Gaussians (ids have 32 bits), got {n}")
    tensor("log_scales", log_scales, (n, 3), dtype=dtype, device=device)
    tensor("quats", quats, (n, 4), dtype=dtype, device=device)
    tensor("logit_opacities", logit_opacities, (n,), dtype=dtype, device=device)
    tensor("sh", sh, (n, coefficients, 3), dtype=dtype, device=device)


def camera(
    viewmat: object,
    K: object,
    width: int,
    height: int,
    degree: int,
    near: float,
    background: object = None,
    *,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> None:
    """Check a camera, and the image size, SH degree, near plane and background to render with."""
    tensor("viewmat", viewmat, (4, 4), dtype=dtype, device=device)
    tensor("K", K, (3, 3), dtype=dtype, device=device)
    image_size(width, height)
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree: expected 0, 1, 2 or 3, got {degree}")
    if not near > 0:
        raise ValueError(f"near: expected a positive distance, got {near}")
    if background is not None:
        tensor("background", background, (3,), dtype=dtype, device=device)


def image_size(width: int, height: int) -> None:
    """Check that both sides are between 1 and LARGEST_SIDE pixels."""
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= LARGEST_SIDE:
            raise ValueError(f"{name}: expected 1 to {LARGEST_SIDE} pixels, got {side}")


def waves(value: Waves, count: int, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> None:
    """Check the waves of `count` Gaussians."""
    tensor("waves.values", value.values, (None, 6), dtype=dtype, device=device)
    tensor("waves.rows", value.rows, (count,), dtype=torch.int32, device=device)

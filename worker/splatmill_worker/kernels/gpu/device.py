"""Which GPU there is, whether these kernels can use it, and what fits into its memory."""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass

import torch
from torch import Tensor

from ..records import TILE
from .blended import PLANES, SEGMENT

OLDEST = (8, 0)
"""Oldest compute capability that Triton compiles for without gaps (Ampere; RTX 30 and later)."""

STEP_BYTES = 1300
"""Device bytes per Gaussian of a training step, estimated: parameters and two moments 3 * 59 * 4 = 708, gradients
236, records 112, scores and lists 60, and the buffers of the sort. `memory_needed` adds densification's copy."""

ROOM = 1.25
"""Room of a view's buffers over what its last visit used: the parameters move slowly from visit to visit."""

LIST_BYTES = 36
"""Device bytes per (tile, Gaussian) pair, estimated: key, id, their sorted copies, the 64-bit index and the buffers of
the sort."""

PAIR_BYTES = round(ROOM * (LIST_BYTES + PLANES * TILE * TILE * 4 / SEGMENT))
"""Device bytes per pair, with its share of the checkpoint that each full segment has, and with room to spare."""

PIXEL_BYTES = 127 + PLANES * 4
"""Device bytes per pixel of a training step: image, its gradient and transmittance 28, a photo over its background 3,
fifteen float32 planes of moments and nine of slopes in the loss 96, and the checkpoint of each tile's last segment."""

STATS_SHARE = 0.05
"""Share of the free memory that the statistics of photos may take; those of further photos are computed again
(decisions: STATS_SHARE)."""

_found_usable: set[int] = set()


class GpuUnavailable(RuntimeError):
    """The GPU backend was asked for and cannot run here; the message says why and what to do."""


class GpuMemoryShort(MemoryError):
    """Device memory ran out during training; the scene is as it was before the call that failed."""

    def __init__(self, where: torch.device, params: Tensor | None) -> None:
        free, total = torch.cuda.mem_get_info(where)
        held = "no" if params is None else str(params.shape[1])
        super().__init__(
            f"The GPU ran out of memory with {held} Gaussians in training: {free / 2**30:.1f} of "
            f"{total / 2**30:.1f} GiB are free. "
            "Use fewer Gaussians or smaller photos, or close other programs that use the GPU."
        )


@dataclass(frozen=True)
class DeviceFacts:
    """One GPU that the kernels can run on.

    name: as its driver gives it.
    capability: compute capability, major and minor.
    total_bytes: its memory.
    free_bytes: what was free of it at the time of asking.
    """

    name: str
    capability: tuple[int, int]
    total_bytes: int
    free_bytes: int


def interpreting() -> bool:
    """Whether Triton's interpreter was asked for, which runs the kernels on CPU tensors: slowly, to test them."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def absence(device: int = 0) -> str | None:
    """Return why GPU number `device` cannot be used, as a sentence for a person; None when it can."""
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed; it comes with torch's CUDA and ROCm builds (pip install torch)."
    if not torch.cuda.is_available():
        built = torch.version.cuda or torch.version.hip
        if built is None:
            return "This build of torch has no GPU support; install torch's CUDA or ROCm build to use a GPU."
        return f"torch (built for {built}) sees no GPU; check the driver with nvidia-smi or rocm-smi."
    if device >= torch.cuda.device_count():
        return f"GPU {device} was asked for and there are {torch.cuda.device_count()}."
    capability = torch.cuda.get_device_capability(device)
    if torch.version.hip is None and capability < OLDEST:
        return (
            f"{torch.cuda.get_device_name(device)} has compute capability {capability[0]}.{capability[1]}; "
            f"the kernels need {OLDEST[0]}.{OLDEST[1]} (GeForce RTX 30, A100) or later."
        )
    return None


def describe(device: int = 0) -> DeviceFacts | None:
    """Return the facts of GPU number `device`; None when it cannot be used, for the reason that `absence` gives."""
    if absence(device) is not None:
        return None
    free, total = torch.cuda.mem_get_info(device)
    return DeviceFacts(
        torch.cuda.get_device_name(device), torch.cuda.get_device_capability(device), total, free
    )


def memory_needed(gaussians: int, pixels: int, photo_bytes: int, *, pairs_per_gaussian: float = 8.0) -> int:
    """Estimate the device bytes that training needs at its peak: in densification, old and new parameters coexist.

    gaussians: the most that there will be. pixels: of the largest view. photo_bytes: of all photos, which stay on the
    device as uint8. pairs_per_gaussian: by default that of ordinary scenes with a million Gaussians at 1080p; where a
    step has more, its lists grow.
    """
    per_gaussian = STEP_BYTES + 708 + pairs_per_gaussian * PAIR_BYTES
    return int(gaussians * per_gaussian + pixels * PIXEL_BYTES + photo_bytes)


def room_for_stats(where: torch.device) -> int:
    """Return the bytes that the statistics of photos may take on a device; on the CPU, as many as they need."""
    return int(STATS_SHARE * torch.cuda.mem_get_info(where)[0]) if where.type == "cuda" else sys.maxsize


def largest_budget(free_bytes: int, pixels: int, photo_bytes: int, *, margin: float = 0.85) -> int:
    """Return the largest number of Gaussians that fits into `margin` of the free memory, less what the statistics of
    photos may take; 0 when the photos do not fit.
    """
    room = free_bytes * (margin - STATS_SHARE) - memory_needed(0, pixels, photo_bytes)
    return max(0, int(room / memory_needed(1, 0, 0)))


def require(tensor: Tensor) -> None:
    """Raise GpuUnavailable unless kernels can run on `tensor`: on a usable GPU, or on the CPU under the interpreter."""
    if interpreting() and not tensor.is_cuda:
        return
    if not tensor.is_cuda:
        raise GpuUnavailable(
            f'backend "gpu" was asked for, but the tensors are on {tensor.device}; move them to a GPU, or use "cpu".'
        )
    index = tensor.device.index or 0
    if index not in _found_usable:
        reason = absence(index)
        if reason is not None:
            raise GpuUnavailable(f'{reason} Use backend "cpu" on this machine.')
        _found_usable.add(index)
    if index != torch.cuda.current_device():
        # Triton launches on the current device, whatever the device of its arguments is.
        raise GpuUnavailable(
            f"The tensors are on {tensor.device}, but the current GPU is number {torch.cuda.current_device()}; "
            f"call torch.cuda.set_device({index}) first."
        )

"""The `.splat` of antimatter15's viewer: 32 bytes a Gaussian without harmonics. It is read, not written.

A row holds position and linear scales as float32, then colour, opacity and a quaternion (wxyz) as bytes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers.reader_memory import check_gaussians
from splatmill_worker.splat.formats.contents import Contents, logits
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

LEAST_SCALE = 2e-9
"""In place of the scale zero of flat Gaussians, whose logarithm is not finite."""


def read(path: Path) -> Contents:
    """Read a `.splat` file. Raises ModelUnreadable, and FileNotFoundError where there is none."""
    try:
        check(path)
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .splat file: {error}.") from error
    rows = np.frombuffer(path.read_bytes(), ROW)
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32) / 255.0)
    gaussians = Gaussians(
        means=torch.from_numpy(rows["mean"].astype(np.float32)),
        log_scales=log_scales(torch.from_numpy(rows["scale"].astype(np.float32))),
        quats=torch.from_numpy((rows["quat"].astype(np.float32) - 128.0) / 128.0),
        logit_opacities=logits(rgba[:, 3]),
        sh=((rgba[:, :3] - 0.5) / SH_C0)[:, None],
    )
    return Contents.of(gaussians)


def check(path: Path) -> None:
    """Raise ValueError if the file does not consist of whole rows, or of too many.

    Raises OSError if it cannot be opened.
    """
    size = path.stat().st_size
    if size % ROW.itemsize:
        raise ValueError(f"its {size} bytes are no whole number of rows of {ROW.itemsize}")
    check_gaussians(size // ROW.itemsize, 0, size)


def log_scales(scales: torch.Tensor) -> torch.Tensor:
    """Logarithms of linear scales; zeros become LEAST_SCALE, negative ones and NaN become NaN."""
    return torch.where(scales >= 0, scales, torch.nan).clamp(min=LEAST_SCALE).log()

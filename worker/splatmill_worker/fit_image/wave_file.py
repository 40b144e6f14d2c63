"""model.npz: a picture fitted with waves. No format of splats has a place for them, and no viewer draws them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatmill.files import replacing
from splatmill_worker.kernels.records import Waves
from splatmill_worker.scene import Camera
from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.gaussians import Gaussians


def write(path: Path, gaussians: Gaussians, waves: Waves, camera: Camera) -> None:
    """Write Gaussians, their waves and the size of the picture; docs/first-splat.md describes the arrays.

    Raises OSError where it cannot be written.
    """
    arrays: dict[str, Any] = {name: value.numpy() for name, value in gaussians.padded(0).parameters().items()}
    arrays |= {"waves": waves.values.numpy(), "wave_rows": waves.rows.numpy()}
    arrays["size"] = np.array([camera.width, camera.height], np.int32)
    with replacing(path) as part, part.open("wb") as stream:
        np.savez(stream, **arrays)


def read(path: Path) -> tuple[Gaussians, Waves]:
    """The Gaussians and waves of a file. Raises OSError, ValueError or KeyError where it is not one of `write`."""
    with np.load(path, allow_pickle=False) as arrays:
        names = ("means", "log_scales", "quats", "logit_opacities", "sh")
        gaussians = Gaussians(**{name: torch.from_numpy(arrays[name]) for name in names})
        return gaussians, Waves(torch.from_numpy(arrays["waves"]), torch.from_numpy(arrays["wave_rows"]))


def rendered(gaussians: Gaussians, waves: Waves, camera: Camera, background: Tensor) -> tuple[Tensor, Tensor]:
    """Colour [H, W, 3] over `background` [3] and alpha [H, W] of the picture at the size that it was fitted at."""
    engine = CpuEngine(gaussians)
    engine.waves = waves
    K = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    color, alpha, _ = engine.forward(
        torch.eye(4), K, camera.width, camera.height, degree=0, background=background
    )
    return color, alpha

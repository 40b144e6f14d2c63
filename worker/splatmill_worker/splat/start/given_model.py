"""A finished model as the start of a training: read, brought into the training world, and judged before it is used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.errors import ModelUnreadable, StartUnusable
from splatmill_worker.scene import Normalization
from splatmill_worker.splat import ply
from splatmill_worker.splat.evaluate import benchmark_background, compare
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render
from splatmill_worker.splat.views import TrainingView

ASSESSED_VIEWS = 8
"""Training views that a model is judged on."""

DOUBTFUL_MARGIN = 3.0
"""dB over one colour per photo: a model in the right world shows its photos far better, unless it is hardly trained."""

OWN_PHOTO_MARGIN = 1.0
"""dB by which a view of a doubtful model must be nearer to its own photo than to another one. On the still
life bare points of the right world are by 1.3 to 2.9, and the same points moved, turned or scaled by 1.0 at most."""


@dataclass(frozen=True)
class GivenModel:
    """What is known of the model given: its size, SH degree, and how it shows training photos before any step.

    psnr, one_color, another in dB: medians over some training views of the model's rendering, of each photo's mean
    colour, which asks for no model at all, and of the rendering against another view's photo.
    """

    gaussians: int
    degree: int
    psnr: float
    one_color: float
    another: float | None

    @property
    def doubtful(self) -> bool:
        """Whether the model says so little about these photos that its world may be another."""
        return not self.psnr > self.one_color + DOUBTFUL_MARGIN

    @property
    def misaligned(self) -> bool:
        """Whether what the model shows has nothing to do with where the cameras stand."""
        return self.doubtful and self.another is not None and not self.psnr > self.another + OWN_PHOTO_MARGIN


def read_given_model(path: Path, frame: Normalization) -> Gaussians:
    """The Gaussians of `path` in the training world. Raises StartUnusable where there are none.

    A model that this program wrote far from its origin says by how much it was moved; that is undone.
    """
    try:
        offset = ply.offset(path)
        gaussians = ply.read(path)
    except ModelUnreadable as error:
        raise StartUnusable(str(error)) from error
    except OSError as error:
        raise StartUnusable(f"{path.name} cannot be opened: {error.strerror or error}.") from error
    if gaussians.count == 0:
        raise StartUnusable(f"{path.name} holds no Gaussian with finite values.")
    shift = frame.scale * np.array(offset) + frame.translation
    return gaussians.moved(frame.scale, torch.from_numpy(shift))


def assess(gaussians: Gaussians, views: Sequence[TrainingView]) -> GivenModel:
    """How `gaussians` show some of `views`. Raises StartUnusable where they show something else."""
    some = views[:: max(1, len(views) // ASSESSED_VIEWS)]
    backdrop = benchmark_background(views)
    shown: list[float] = []
    plain: list[float] = []
    other: list[float] = []
    with torch.no_grad():
        half = len(some) // 2
        for view, far in zip(some, [*some[half:], *some[:half]], strict=True):
            target, beyond = view.full, far.full
            photo = target.over(backdrop)
            color = render(gaussians, target.camera, background=backdrop).color
            shown.append(compare(view.name, color, photo, target.mask).psnr)
            plain.append(compare(view.name, _one_color(photo, target.mask), photo, target.mask).psnr)
            if beyond.rgb.shape == target.rgb.shape and len(some) > 1:
                other.append(compare(view.name, color, beyond.over(backdrop), beyond.mask).psnr)
    start = GivenModel(
        gaussians.count,
        gaussians.degree,
        float(np.median(shown)),
        float(np.median(plain)),
        float(np.median(other)) if other else None,
    )
    if start.misaligned:
        raise StartUnusable(
            f"The model's views are as near to other photos ({start.another:.1f} dB) as to their own "
            f"({start.psnr:.1f} dB; one colour per photo: {start.one_color:.1f} dB): it is not in the world of these "
            "cameras."
        )
    return start


def _one_color(photo: Tensor, mask: Tensor | None) -> Tensor:
    """The mean colour of a photo's pixels that count, everywhere [H, W, 3]; the photo is uint8."""
    values = photo.float() / 255.0
    counted = values.reshape(-1, 3) if mask is None or not bool(mask.any()) else values[mask]
    return counted.mean(dim=0).expand_as(values)

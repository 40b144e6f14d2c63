"""A given model to start from: read, moved into the training world, and compared with the photos before it is used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.errors import ModelUnreadable, Refusal, StartUnusable
from splatmill_worker.images.decoding import decoders
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.evaluate import benchmark_background, compare
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render
from splatmill_worker.splat.start import given_file
from splatmill_worker.splat.views import TrainingView

ASSESSED_VIEWS = 8
"""Least number of training views on which a model is assessed; all of them where there are fewer."""

LEAST_ASSESSED = 200_000
"""Gaussians that are kept of a model whatever max_gaussians is, so that it is compared with the photos as it is."""

DOUBTFUL_MARGIN = 3.0
"""dB of PSNR over the baseline of one colour per photo, up to which a model is doubtful: a trained model in the right
world exceeds it by far."""

OWN_PHOTO_MARGIN = 1.0
"""dB by which the views of a doubtful model have to be nearer to their own photos than to others, or the model lies in
another world (decisions: OWN_PHOTO_MARGIN)."""


_MOST_NOTES, _MOST_NOTE = 10, 200
"""Sentences about a file that are passed on, and characters of one."""


@dataclass(frozen=True)
class GivenModel:
    """What is known of a given model before the first step. Values in dB are medians over some of the training views.

    gaussians: number of Gaussians.
    degree: of the spherical harmonics.
    psnr: PSNR of the model's views, dB.
    one_color: PSNR of the baseline, a constant colour per photo, dB.
    another: PSNR of the model's views against photos of other views, dB; None where no two photos have the same size.
    antialiased: whether its file says that it is drawn antialiased; None where the file does not say so.
    """

    gaussians: int
    degree: int
    psnr: float
    one_color: float
    another: float | None
    antialiased: bool | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the model is so near to the baseline that it may be of another scene or lie in another world."""
        return not self.psnr > self.one_color + DOUBTFUL_MARGIN

    @property
    def misaligned(self) -> bool:
        """Whether the model lies in another world: its views match their own photos no better than other photos."""
        return self.doubtful and self.another is not None and not self.psnr > self.another + OWN_PHOTO_MARGIN


@dataclass(frozen=True)
class Start:
    """What is read of the file of a given model.

    gaussians: the most opaque ones, in the training world.
    count: number of Gaussians of the file.
    antialiased, notes: as in `splat.formats.contents.Contents`.
    """

    gaussians: Gaussians
    count: int
    antialiased: bool | None
    notes: tuple[str, ...] = ()


def read_given_model(path: Path, normalization: Normalization, most: int) -> Start:
    """The model in the file `path`, of which the `most` most opaque Gaussians are kept.

    The file may be of any readable format; it is moved by `normalization`.

    Far from the origin, export subtracts an offset and stores it in the file; it is added again.
    Raises StartUnusable where the file cannot be read or holds no Gaussian.
    """
    try:
        start, offset = decoders.call_once(given_file.read, path, most, check=_start, fault=_fault)
    except ModelUnreadable as error:
        raise StartUnusable(error.message) from error
    except OSError as error:
        raise StartUnusable(f"{path.name} cannot be opened: {error.strerror or error}.") from error
    if start.gaussians.count == 0:
        raise StartUnusable(f"{path.name} holds no Gaussian with finite values.")
    shift = normalization.scale * np.array(offset) + normalization.translation
    return replace(start, gaussians=start.gaussians.moved(normalization.scale, torch.from_numpy(shift)))


def _start(answer: Any) -> tuple[Start, list[float]]:
    """What `given_file.read` returns as a `Start`, in the coordinates of the file, and its offset.

    Raises ValueError and KeyError.
    """
    values = {field.name: torch.from_numpy(answer[field.name]) for field in fields(Gaussians)}
    gaussians = Gaussians(**values)
    x, y, z = (float(value) for value in answer["offset"])
    if not all(value.dtype == torch.float32 for value in gaussians) or not bool(gaussians.finite().all()):
        raise ValueError("a parameter is no finite float32")
    antialiased = answer["antialiased"]
    if not isinstance(antialiased, bool | None):
        raise ValueError("it is not said whether the model is drawn antialiased")
    notes = tuple(str(note)[:_MOST_NOTE] for note in answer["notes"][:_MOST_NOTES])
    return Start(gaussians, int(answer["count"]), antialiased, notes), [x, y, z]


def _fault(code: str, name: str, reason: str) -> Exception:
    message = f"{name} could not be read: {reason}."
    if code != "decoder_ended":
        return StartUnusable(message)
    return Refusal(code, message, advice="Restart the job, or leave out the option start.")


def assess(
    gaussians: Gaussians, views: Sequence[TrainingView], *, antialiased: bool | None = None
) -> GivenModel:
    """Compare renderings of `gaussians` with the photos of some of `views`.

    antialiased: of the file of the model; they are rendered so where it says so.
    Raises StartUnusable where the Gaussians lie in another world.
    """
    some = views[:: max(1, len(views) // ASSESSED_VIEWS)]
    background = benchmark_background(views)
    own: list[float] = []
    baseline: list[float] = []
    others: list[float] = []
    with torch.no_grad():
        half = len(some) // 2
        for view, other in zip(some, [*some[half:], *some[:half]], strict=True):
            target, wrong = view.full, other.full
            photo = target.over(background)
            color = render(gaussians, target.camera, background=background, antialias=bool(antialiased)).color
            own.append(compare(view.name, color, photo, target.mask).psnr)
            baseline.append(compare(view.name, _one_color(photo, target.mask), photo, target.mask).psnr)
            if wrong.rgb.shape == target.rgb.shape and len(some) > 1:
                others.append(compare(view.name, color, wrong.over(background), wrong.mask).psnr)
    model = GivenModel(
        gaussians.count,
        gaussians.degree,
        float(np.median(own)),
        float(np.median(baseline)),
        float(np.median(others)) if others else None,
        antialiased,
    )
    if model.misaligned:
        raise StartUnusable(
            f"The model's views differ from their own photos ({model.psnr:.1f} dB) as much as from other photos "
            f"({model.another:.1f} dB), and a constant colour per photo gives {model.one_color:.1f} dB: the model does "
            "not lie in the world of these cameras."
        )
    return model


def _one_color(photo: Tensor, mask: Tensor | None) -> Tensor:
    """A photo [H, W, 3] of one colour, 0 to 1: the mean of `photo`, uint8 [H, W, 3], where `mask` keeps it."""
    values = photo.float() / 255.0
    counted = values.reshape(-1, 3) if mask is None or not bool(mask.any()) else values[mask]
    return counted.mean(dim=0).expand_as(values)

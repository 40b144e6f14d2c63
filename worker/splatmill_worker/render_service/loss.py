"""What a model loses in another file format: PSNR of its views against photos, and against the views it had before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images.load import load_view
from splatmill_worker.scene import Camera, View
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render

SAME_PHOTO = 0.5
"""dB of PSNR by which the model may differ from the figure in its cameras.json, for a photo to count as the one that it
was compared with then. A photo with lens distortion, a mask or another size differs by more."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera of a model, and what is known of its photo.

    name: of the photo; empty where the camera has none.
    psnr: what the model had on the photo when it was trained, dB.
    photo: file of the photo; None where there is none.
    counted: whether transparent pixels of that file are those that do not count, as in held_out/ of a model. Else
        they show what is behind.
    """

    camera: Camera
    name: str = ""
    psnr: float | None = None
    photo: Path | None = None
    counted: bool = False


@dataclass(frozen=True)
class RenderedView:
    """A view of the model before the conversion.

    camera: of the view.
    background: 0 for black, 1 for white.
    before: colours [H, W, 3], 0 to 1.
    photo: colours of the photo in the same place; None where none is known.
    mask: bool [H, W], the pixels of the photo that count; None: all.
    """

    camera: Camera
    background: float
    before: Tensor
    photo: Tensor | None = None
    mask: Tensor | None = None


@dataclass(frozen=True)
class Loss:
    """Means over the views, dB.

    views: PSNR against the views of the model before the conversion.
    photos_before, photos_after: PSNR against the photos; None where a view has none.
    """

    views: float
    photos_before: float | None
    photos_after: float | None


def look(
    gaussians: Gaussians, viewpoints: Sequence[Viewpoint], *, antialias: bool
) -> tuple[list[RenderedView], list[str]]:
    """Render the views of a model before its conversion; returns them, and a sentence for each photo that is not used.

    The background is black, or white where the model is as near to its photo as it was only over white.
    """
    originals, notes = [], []
    for viewpoint in viewpoints:
        black = RenderedView(viewpoint.camera, 0.0, _colors(gaussians, viewpoint.camera, 0.0, antialias))
        view = black
        if viewpoint.photo is not None:
            try:
                view = _with_photo(gaussians, viewpoint, black, antialias)
            except (OSError, ValueError, UnusablePicture) as error:
                notes.append(f"{viewpoint.name} is not compared with: {error}")
        originals.append(view)
    return originals, notes


def loss(gaussians: Gaussians, originals: Sequence[RenderedView], *, antialias: bool) -> Loss:
    """Compare the views of a converted model with `originals`, those before the conversion, and with the photos."""
    views, before, after = [], [], []
    for view in originals:
        color = _colors(gaussians, view.camera, view.background, antialias)
        views.append(_psnr(color, view.before, None))
        if view.photo is not None:
            before.append(_psnr(view.before, view.photo, view.mask))
            after.append(_psnr(color, view.photo, view.mask))
    return Loss(_mean(views), _mean(before) if before else None, _mean(after) if after else None)


def _with_photo(
    gaussians: Gaussians, viewpoint: Viewpoint, black: RenderedView, antialias: bool
) -> RenderedView:
    """The view with its photo. Raises ValueError where the photo is not what the model was compared with before."""
    assert viewpoint.photo is not None
    camera = viewpoint.camera
    view = View(viewpoint.name, camera, viewpoint.photo)
    psnr = math.nan
    for background in (0.0, 1.0):
        before = black.before if not background else _colors(gaussians, camera, background, antialias)
        behind = None if viewpoint.counted else (background,) * 3
        loaded = load_view(view, max(camera.width, camera.height), background=behind)
        photo = torch.from_numpy(loaded.rgb).float() / 255.0
        transparent = loaded.alpha is not None and viewpoint.counted
        mask = torch.from_numpy(loaded.alpha >= 128) if transparent and loaded.alpha is not None else None
        psnr = _psnr(before, photo, mask)
        if viewpoint.psnr is None or abs(psnr - viewpoint.psnr) <= SAME_PHOTO:
            return RenderedView(camera, background, before, photo, mask)
    raise ValueError(
        f"the model has {psnr:.2f} dB on it, and had {viewpoint.psnr:.2f} dB on what it was trained on. The photo has "
        "lens distortion or a mask, or was changed."
    )


def _colors(gaussians: Gaussians, camera: Camera, background: float, antialias: bool) -> Tensor:
    with torch.no_grad():
        shown = render(gaussians, camera, background=torch.full((3,), background), antialias=antialias)
    return shown.color.clamp(0.0, 1.0)


def _psnr(color: Tensor, truth: Tensor, mask: Tensor | None) -> float:
    squares = (color - truth).square().mean(dim=2)
    return psnr(float((squares if mask is None else squares[mask]).double().mean()))


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)

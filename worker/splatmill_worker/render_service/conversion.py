"""A stored model in another file format, and how much worse its pictures are than those of the model."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    CONVERSION_VERSION,
    ComparedWith,
    Conversion,
    ModelCamera,
    ModelCameras,
    ModelFormat,
)

if TYPE_CHECKING:
    from torch import Tensor

    from splatmill_worker.render_service.model_cache import LoadedModel
    from splatmill_worker.splat.gaussians import Gaussians

MOST_PICTURES = 8
"""Pictures that are compared. Each takes up to half a second of both cores."""


@dataclass(frozen=True)
class PictureScore:
    """A picture of the converted model: PSNR in dB and SSIM, and the PSNR of the model itself where it is known."""

    psnr: float
    ssim: float
    before: float | None


def convert(
    model: LoadedModel, form: ModelFormat, folder: Path, storage: Storage | None = None
) -> tuple[Path, Gaussians, Conversion]:
    """Write the model to a file in `folder`; return it, what is read back from it, and the record of the conversion.

    storage: where its cameras are, which say what is up; None: that is not asked for.
    """
    from splatmill_worker.render_service.world_up import up_of
    from splatmill_worker.splat.formats import registry

    began = time.perf_counter()
    path = folder / f"model{form.suffix}"
    up = None if storage is None else up_of(_cameras_of(storage, model.id))
    count = registry.write(path, model.gaussians, offset=model.offset, antialiased=model.antialias, up=up)
    seconds = time.perf_counter() - began
    back = registry.read(path).gaussians if form.readable else model.gaussians
    if model.backend == "gpu":
        back = back.map(lambda tensor: tensor.cuda())
    record = Conversion(model=model.etag, version=CONVERSION_VERSION, gaussians=count, seconds=seconds)
    return path, back, record


def pictures_of(storage: Storage, model_id: str) -> tuple[list[ModelCamera], ComparedWith | None]:
    """The cameras to compare from, and what with: held-out photos, renderings where there are none, or nothing."""
    stored = _cameras_of(storage, model_id)
    if stored is None:
        return [], None
    photos = [camera for camera in stored.cameras if camera.photo is not None]
    if photos:
        return _evenly(photos), ComparedWith.held_out
    return _evenly(stored.cameras), ComparedWith.renderings if stored.cameras else None


def _cameras_of(storage: Storage, model_id: str) -> ModelCameras | None:
    try:
        return ModelCameras.model_validate_json(storage.get(layout.model_file(model_id, "cameras.json")))
    except (FileNotFoundError, ValueError):
        return None


def background_of(storage: Storage, model_id: str) -> float:
    """Grey level, 0 or 1, behind the model where its held-out photos are compared, from the plan in its report."""
    try:
        plan: Any = json.loads(storage.get(layout.model_file(model_id, "report.json")))["plan"]
        if plan["background"] == "random":  # as in published results: white where photos are transparent
            return 0.0 if "alpha" in plan["left_out"] else 1.0
        return 1.0 if plan["background"] == "white" else 0.0
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return 0.0


def score(
    storage: Storage, model: LoadedModel, back: Gaussians, view: ModelCamera, background: float
) -> PictureScore:
    """Compare a picture of `back`, read from a converted file, with a held-out photo or with one of the model."""
    from splatmill_worker.splat.evaluate import compare

    shown = _rendered(model, back, view, background)
    if view.photo is None:
        original = (_rendered(model, model.gaussians, view, background).clamp(0, 1) * 255).round().byte()
        comparison = compare(view.name, shown, original)
        return PictureScore(comparison.psnr, comparison.ssim, None)
    photo, mask = _photo(storage, model.id, view.photo)
    comparison = compare(view.name, shown, photo, mask)
    return PictureScore(comparison.psnr, comparison.ssim, view.psnr)


def with_scores(record: Conversion, scores: Sequence[PictureScore], what: ComparedWith | None) -> Conversion:
    """The record with the means over the pictures."""
    if not scores or not all(math.isfinite(each.psnr) for each in scores):
        return record
    before = [each.before for each in scores if each.before is not None]
    return record.model_copy(
        update={
            "compared_with": what,
            "pictures": len(scores),
            "psnr": sum(each.psnr for each in scores) / len(scores),
            "ssim": sum(each.ssim for each in scores) / len(scores),
            "psnr_before": sum(before) / len(before) if len(before) == len(scores) else None,
        }
    )


def _evenly(cameras: Sequence[ModelCamera]) -> list[ModelCamera]:
    count = min(MOST_PICTURES, len(cameras))
    return [cameras[index * len(cameras) // count] for index in range(count)]


def _rendered(model: LoadedModel, gaussians: Gaussians, view: ModelCamera, background: float) -> Tensor:
    import torch

    from splatmill_worker.render_service.encoding import camera_of
    from splatmill_worker.splat.render import render

    with torch.no_grad():
        return render(
            gaussians,
            camera_of(view.camera),
            background=(background, background, background),
            antialias=model.antialias,
            backend=cast(Any, model.backend),
        ).color


def _photo(storage: Storage, model_id: str, name: str) -> tuple[Tensor, Tensor | None]:
    """A held-out photo uint8 [H, W, 3], and which of its pixels count: those that are not transparent."""
    import numpy as np
    import torch

    from splatmill_worker.images import guarded

    if layout.model_media_type(name) != "image/webp":
        raise ValueError(f"cameras.json names {name[:80]!r} as a held-out photo")
    data = storage.get(layout.model_file(model_id, name))
    with guarded.opened_bytes(data, name, ("WEBP",)) as image, guarded.damage(name):
        pixels = torch.from_numpy(np.array(image))
    mask = pixels[..., 3] > 0 if pixels.shape[2] == 4 else None
    return pixels[..., :3].contiguous(), mask

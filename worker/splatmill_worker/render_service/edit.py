"""Edits of a stored model: which Gaussians stay, and what that changes on the held-out photos."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Edited, EditedView, EditModel, ModelCameras
from splatmill_worker.images.guarded import own_picture
from splatmill_worker.render_service.conversion import background_of
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.model_cache import antialias_of
from splatmill_worker.render_service.selection import selected
from splatmill_worker.scene import Camera
from splatmill_worker.splat.evaluate import Score, compare
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render

MOST_PHOTOS = 16
"""Held-out photos that are measured; of more, an even choice."""


class NothingLeft(Exception):
    """An edit leaves all Gaussians out."""


class HeldOut(NamedTuple):
    """A held-out photo of a model.

    name: of the photo.
    camera: its camera.
    photo: uint8 [H, W, 3].
    mask: bool [H, W], true at the pixels that count; None where all do.
    """

    name: str
    camera: Camera
    photo: Tensor
    mask: Tensor | None


def edit(storage: Storage, model_id: str, request: EditModel, backend: str | None, path: Path) -> Edited:
    """Return what an edit does, and write the model that it leaves to `path`, unless it is a preview.

    Raises NothingLeft, ModelUnreadable, FileNotFoundError and StorageError.
    """
    with tempfile.TemporaryDirectory(prefix="splatmill-edit-") as folder:
        local = storage.local_path(layout.model_file(model_id, "model.ply"))
        if local is None:
            local = Path(folder) / "model.ply"
            storage.download(layout.model_file(model_id, "model.ply"), local)
        contents = ply.read(local)
    whole = contents.gaussians
    left = whole.select(kept(whole, request))
    if left.count == 0:
        raise NothingLeft
    photos = _held_out(storage, model_id)
    antialias = contents.antialiased
    if antialias is None:
        try:
            antialias = antialias_of(storage.get(layout.model_file(model_id, "report.json")))
        except FileNotFoundError:
            antialias = False
    grey = background_of(storage, model_id)
    background = (grey, grey, grey)
    before = _score(whole, photos, background, antialias, backend)
    after = _score(left, photos, background, antialias, backend)
    edited = Edited(
        gaussians_before=whole.count,
        gaussians=left.count,
        crops=request.crops,
        psnr_before=None if before is None else before.psnr,
        psnr=None if after is None else after.psnr,
        views=[EditedView(name=v.name, psnr=v.psnr, ssim=v.ssim) for v in (after.views if after else ())],
    )
    if not request.preview:
        comments = ("Made by Splatmill",)
        ply.write(path, left, offset=contents.offset, antialiased=antialias, comments=comments)
    return edited


def kept(gaussians: Gaussians, request: EditModel) -> Tensor:
    """bool [N]: the Gaussians that an edit leaves."""
    keep = torch.ones(gaussians.count, dtype=torch.bool, device=gaussians.means.device)
    if request.box is not None:
        low, high = (gaussians.means.new_tensor(corner) for corner in (request.box.min, request.box.max))
        keep &= ((gaussians.means >= low) & (gaussians.means <= high)).all(dim=1)
    if request.min_opacity is not None:
        keep &= torch.sigmoid(gaussians.logit_opacities) >= request.min_opacity
    if request.max_size is not None:
        keep &= gaussians.log_scales.exp().amax(dim=1) <= request.max_size
    if request.selection is not None:
        keep &= ~torch.from_numpy(selected(gaussians.means.numpy(), request.selection))
    return keep


def _score(
    gaussians: Gaussians,
    photos: Sequence[HeldOut],
    background: tuple[float, float, float],
    antialias: bool,
    backend: str | None,
) -> Score | None:
    """The scores on the photos; None without any."""
    if not photos:
        return None
    if backend == "gpu":
        gaussians = gaussians.map(lambda value: value.cuda())
    scores = []
    for name, camera, photo, mask in photos:
        with torch.no_grad():
            picture = render(
                gaussians, camera, background=background, antialias=antialias, backend=cast(Any, backend)
            )
        scores.append(compare(name, picture.color.cpu(), photo, mask))
    return Score(tuple(scores))


def _held_out(storage: Storage, model_id: str) -> list[HeldOut]:
    try:
        stored = ModelCameras.model_validate_json(storage.get(layout.model_file(model_id, "cameras.json")))
    except FileNotFoundError:
        return []
    cameras = [row for row in stored.cameras if layout.model_media_type(row.photo or "") == "image/webp"]
    chosen = cameras[:: max(1, -(-len(cameras) // MOST_PHOTOS))]
    photos = []
    with tempfile.TemporaryDirectory(prefix="splatmill-photos-") as folder:
        for row in chosen:
            file = Path(folder) / "photo.webp"
            storage.download(layout.model_file(model_id, str(row.photo)), file)
            with own_picture(file) as picture:
                pixels = torch.from_numpy(np.asarray(picture.convert("RGBA")).copy())
            counted = pixels[..., 3] > 0
            mask = None if bool(counted.all()) else counted
            photos.append(HeldOut(row.name, camera_of(row.camera), pixels[..., :3].contiguous(), mask))
    return photos

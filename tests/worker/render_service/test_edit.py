"""Proves which Gaussians an edit leaves, that its model is stored whole elsewhere, and that the error it reports is
that of the renderer against the held-out photos.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import CameraSpec, EditModel
from splatmill_worker.render_service.edit import NothingLeft, edit, kept
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.render import render
from tests.support.ball import BALL, store_ball

HALF = EditModel.model_validate({"box": {"min": [0, -2, -2], "max": [2, 2, 2]}})


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    """The ball, with one held-out photo that is its own rendering; the left half of the photo does not count."""
    store = Storage(str(tmp_path / "storage"))
    store_ball(store, tmp_path)
    camera = CameraSpec.looking_at((0, -4, 0), (0, 0, 0), width=64, height=48)
    model = ply.read(tmp_path / "model.ply").gaussians
    color = render(model, camera_of(camera), background=(0.0, 0.0, 0.0)).color
    pixels = np.full((48, 64, 4), 255, np.uint8)
    pixels[..., :3] = (color.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    pixels[:, :32, 3] = 0
    picture = tmp_path / "photo.webp"
    Image.fromarray(pixels).save(picture, "WEBP", lossless=True, exact=True)
    store.put(layout.model_file(BALL, "held_out/000.webp"), picture)
    row = {
        "name": "a.jpg",
        "split": "test",
        "camera": camera.model_dump(mode="json"),
        "photo": "held_out/000.webp",
    }
    store.put(layout.model_file(BALL, "cameras.json"), json.dumps({"cameras": [row]}).encode())
    return store


def test_box_opacity_and_size_choose_what_stays(storage: Storage, tmp_path: Path) -> None:
    ball = ply.read(tmp_path / "model.ply").gaussians
    right = int((ball.means[:, 0] >= 0).sum())
    assert int(kept(ball, HALF).sum()) == right
    opacity = float(torch.sigmoid(torch.tensor(4.0)))
    for field, under, over in (("min_opacity", opacity - 0.01, opacity + 0.01), ("max_size", 0.2, 0.05)):
        assert bool(kept(ball, EditModel.model_validate({field: under})).all())
        assert not bool(kept(ball, EditModel.model_validate({field: over})).any())


def test_an_edit_tells_its_error_and_leaves_a_model(storage: Storage, tmp_path: Path) -> None:
    before = {entry.path: entry.etag for entry in storage.entries("models")}
    path = tmp_path / "edited.ply"
    edited = edit(storage, BALL, HALF, None, path)
    left = ply.read(path).gaussians
    path.unlink()
    assert left.count == edited.gaussians < edited.gaussians_before == 400
    assert bool((left.means[:, 0] >= 0).all())
    assert edited.psnr_before is not None
    assert edited.psnr is not None
    # Before, the only error is the rounding to 8 bits. The other half of the ball lies where pixels do not count.
    assert edited.psnr_before > 50
    assert 15 < edited.psnr < edited.psnr_before
    assert [view.name for view in edited.views] == ["a.jpg"]
    assert {entry.path: entry.etag for entry in storage.entries("models")} == before
    assert edit(storage, BALL, HALF.model_copy(update={"preview": True}), None, path) == edited
    assert not path.exists(), "a preview writes no model"


def test_an_edit_that_leaves_nothing_is_refused(storage: Storage, tmp_path: Path) -> None:
    with pytest.raises(NothingLeft):
        edit(storage, BALL, EditModel(max_size=1e-6), None, tmp_path / "none.ply")

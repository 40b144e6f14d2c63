"""Proves what `clean-file` removes from a file: by a box, by weight, and what its photos do not support.

The photos are renderings of the model before anything was planted, so that all that it had is supported. Does not prove
the evidence (tests/worker/splat/test_evidence.py) nor the command's own checks (tests/client/cli/test_clean.py).
"""

from __future__ import annotations

import json
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill.schema import CameraSpec, EditModel, ModelCamera, ModelCameras
from splatmill_worker.errors import Refusal
from splatmill_worker.render_service.clean import CleanSettings, clean_file, main, table
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.render import render
from tests.support.gaussians import some_gaussians
from tests.support.posed_sets import document

OWN, PLANTED = 300, 5
SPECS = [
    CameraSpec.looking_at((5.0 * np.cos(a), 5.0 * np.sin(a), 1.0), (0, 0, 0), width=64, height=48)
    for a in np.linspace(0.0, 5.5, 9)
]


@dataclass(frozen=True)
class Spoilt:
    """A model with PLANTED floaters behind its OWN Gaussians, and the photos of the model without them.

    capture: folder of the photos with their cameras, as nerfstudio has them.
    """

    model: Path
    capture: Path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Spoilt:
    folder = tmp_path_factory.mktemp("clean")
    own = some_gaussians(OWN, 1)
    own.log_scales.add_(0.8)
    floaters = Gaussians(
        torch.tensor([[2.0, 0, 0.3], [-2, 0.5, 0.2], [0, 2, 0.5], [1.4, -1.4, 0], [-0.5, -2, 0.4]]),
        torch.full((PLANTED, 3), -1.8),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(PLANTED, 1),
        torch.full((PLANTED,), 3.0),
        torch.cat([torch.tensor([[[1.7, -1.7, 1.7]]]), torch.zeros(1, 3, 3)], dim=1).repeat(PLANTED, 1, 1),
    )
    ply.write(folder / "model.ply", concatenate(own, floaters))
    images = folder / "capture" / "images"
    images.mkdir(parents=True)
    views = {f"{index}.png": camera_of(spec) for index, spec in enumerate(SPECS)}
    cameras = []
    for index, (name, view) in enumerate(views.items()):
        shown = render(own, view).color.clamp(0, 1).numpy() * 255
        Image.fromarray(shown.round().astype(np.uint8)).save(images / name)
        cameras.append(ModelCamera(name=name, split="test" if index == 4 else "train", camera=SPECS[index]))
    (folder / "capture" / "transforms.json").write_text(json.dumps(document(views)))
    (folder / "cameras.json").write_text(ModelCameras(cameras=cameras).model_dump_json(exclude_none=True))
    return Spoilt(folder / "model.ply", folder / "capture")


@pytest.mark.slow
def test_what_the_photos_do_not_support_goes_and_the_rest_stays(made: Spoilt, tmp_path: Path) -> None:
    out = tmp_path / "cleaned.ply"
    cleaned = clean_file(made.model, out, CleanSettings(capture=made.capture))
    whole, left = ply.read(made.model).gaussians, ply.read(out).gaussians
    assert cleaned.before == OWN + PLANTED
    assert cleaned.left == left.count == OWN
    assert torch.equal(left.means, whole.means[:OWN])
    assert sum(cleaned.removed.values()) == PLANTED
    assert cleaned.photos is not None
    assert cleaned.held_out is not None
    assert cleaned.photos[0] == 8
    assert cleaned.held_out[0] == 1
    # Photos have 8 bits: 58.9 dB where each value is off by at most half a level.
    for _, before, after in (cleaned.photos, cleaned.held_out):
        assert before < 40.0
        assert after > 55.0
    lines = table(cleaned).splitlines()
    assert lines[0].split() == ["removed", "Gaussians", "share"]
    # A reason for which nothing went has a line too, so that the table is of one shape for every model.
    assert [line.split()[1] for line in lines[1:6]] == ["needle", "giant", "floater", "island", "other"]
    assert lines[-3].split()[:2] == ["left", f"{OWN}"]
    assert "on 8 training photos" in lines[-2]
    assert "on 1 held-out photo:" in lines[-1]


def test_a_box_and_a_weight_need_no_photos(made: Spoilt, tmp_path: Path) -> None:
    out = tmp_path / "cleaned.ply"
    box = EditModel.model_validate({"box": {"min": (-1, -1, -9), "max": (1, 1, 9)}})
    cleaned = clean_file(made.model, out, CleanSettings(edit=box))
    means = ply.read(made.model).gaussians.means
    inside = (means[:, :2].abs() <= 1).all(dim=1)
    assert cleaned.left == int(inside.sum())
    assert cleaned.removed == {"outside the box": int((~inside).sum())}
    assert torch.equal(ply.read(out).gaussians.means, means[inside])
    heavy = clean_file(made.model, out, CleanSettings(min_weight=20.0))
    assert 0 < heavy.left < OWN
    assert heavy.removed == {"weight below 20": OWN + PLANTED - heavy.left}
    assert heavy.photos is None
    assert clean_file(made.model, out, CleanSettings(min_weight=0.0)).left == OWN + PLANTED


@pytest.mark.slow
def test_photos_alone_take_the_cameras_beside_the_model(made: Spoilt, tmp_path: Path) -> None:
    shutil.copytree(made.capture / "images", tmp_path / "photos")
    shutil.copy(made.model, tmp_path / "model.ply")
    options = CleanSettings(capture=tmp_path / "photos", image_size=64)
    with pytest.raises(Refusal, match=r"has no cameras .* no cameras.zip beside model.ply"):
        clean_file(tmp_path / "model.ply", tmp_path / "out.ply", options)
    with zipfile.ZipFile(tmp_path / "cameras.zip", "w") as archive:
        archive.writestr("../outside.txt", "one directory up")
    with pytest.raises(Refusal, match=r"cameras.zip is damaged: .*outside.txt"):
        clean_file(tmp_path / "model.ply", tmp_path / "out.ply", options)
    (tmp_path / "cameras.zip").write_bytes(b"none")
    with pytest.raises(Refusal, match="is damaged"):
        clean_file(tmp_path / "model.ply", tmp_path / "out.ply", options)
    folder = tmp_path / "zipped"
    folder.mkdir()
    shutil.copy(made.capture / "transforms.json", folder)
    shutil.make_archive(str(tmp_path / "cameras"), "zip", folder)
    # Without a cameras.json, every eighth photo is held out, as in a training.
    cleaned = clean_file(tmp_path / "model.ply", tmp_path / "out.ply", options)
    assert cleaned.left == OWN
    assert cleaned.held_out is not None
    assert cleaned.held_out[0] == 2


def test_a_damaged_cameras_json_is_refused(made: Spoilt, tmp_path: Path) -> None:
    """Without it, photos that training has left out would decide."""
    shutil.copy(made.model, tmp_path / "model.ply")
    (tmp_path / "cameras.json").write_text('{"cameras": [')
    for options in (CleanSettings(capture=made.capture), CleanSettings(min_weight=1.0)):
        with pytest.raises(
            Refusal, match=r"cameras.json is damaged: .+\. It names the photos that were held out"
        ):
            clean_file(tmp_path / "model.ply", tmp_path / "out.ply", options)
    assert not (tmp_path / "out.ply").exists()


def test_a_model_of_another_scene_is_refused(
    made: Spoilt, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of it would be unsupported."""
    other = some_gaussians(OWN, 1, seed=5)
    ply.write(tmp_path / "model.ply", other)
    out = tmp_path / "out.ply"
    assert main(tmp_path / "model.ply", out, CleanSettings(capture=made.capture)) == 5
    assert "dB" in capsys.readouterr().err
    assert not out.exists()


def test_nothing_left_and_no_cameras_are_refused(made: Spoilt, tmp_path: Path) -> None:
    away = EditModel.model_validate({"box": {"min": (50, 50, 50), "max": (51, 51, 51)}})
    with pytest.raises(Refusal, match="Nothing would be left of the 305 Gaussians"):
        clean_file(made.model, tmp_path / "out.ply", CleanSettings(edit=away))
    shutil.copy(made.model, tmp_path / "model.ply")
    with pytest.raises(Refusal, match=r"no cameras.json beside model.ply. Give the photos"):
        clean_file(tmp_path / "model.ply", tmp_path / "out.ply", CleanSettings(min_weight=1.0))
    assert not (tmp_path / "out.ply").exists()

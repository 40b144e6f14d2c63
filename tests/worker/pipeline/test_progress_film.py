"""Proves that a training is filmed from one view, off the clock, and that the film continues after a cancelled attempt.

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

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
from tests.support import still_life

pytestmark = pytest.mark.slow


def filmed(capture: Path, work: Path, cancelled: Callable[[], bool] = lambda: False) -> pipeline.Outcome:
    options = TrainOptions(steps=100, seed=1, max_gaussians=3000, progress_video=True)
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

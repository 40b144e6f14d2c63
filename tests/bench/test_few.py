"""Proves what a capture with few photos keeps of the whole scene, and that it is read back as such."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.pipeline.holdout.split import split_views
from splatmill_worker.scene import PointViews, Scene, View
from splatmill_worker.sfm import posed
from splatmill_worker.synthetic import look_at
from tests.support.paths import BENCH

TRAIN, TEST, POINTS = 20, 5, 200


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("_train.few")


@pytest.fixture
def whole(tmp_path: Path) -> Scene:
    """Photos around a cloud of points, of which each is seen by some at random."""
    rng = np.random.default_rng(0)
    views = []
    for at in range(TRAIN + TEST):
        eye = np.array([3 * np.cos(at / 4), -0.5, 3 * np.sin(at / 4)])
        camera = look_at(eye, np.zeros(3), width=64, height=48, focal=60.0)
        path = tmp_path / "photos" / f"{at:02d}.jpg"
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (camera.width, camera.height), (at, 0, 0)).save(path)
        views.append(View(path.name, camera, path))
    tracks = [np.sort(rng.choice(TRAIN + TEST, rng.integers(2, 7), replace=False)) for _ in range(POINTS)]
    return Scene(
        tuple(views),
        rng.normal(0, 0.2, (POINTS, 3)),
        rng.integers(0, 256, (POINTS, 3)).astype(np.uint8),
        "colmap",
        point_views=PointViews(
            np.cumsum([0, *map(len, tracks)]).astype(np.int64), np.concatenate(tracks).astype(np.int32)
        ),
    )


def test_training_photos_are_thinned_out_and_held_out_ones_stay(
    few: Any, whole: Scene, tmp_path: Path
) -> None:
    train, test = split_views(whole, TrainOptions(holdout=5))
    few.make("synthetic-9", tmp_path / "capture", whole, train, test)
    poses = posed.find(tmp_path / "capture")
    assert poses is not None
    scene = poses.load()
    chosen, held_out = split_views(scene, TrainOptions(test_views=tuple(few.held_out("synthetic-9"))))
    assert [view.image.resolve() for view in held_out] == [view.image for view in test]
    numbers = [
        train.index(next(each for each in train if each.image == view.image.resolve())) for view in chosen
    ]
    assert len(numbers) == 9
    assert set(np.diff(numbers)) <= {2, 3}
    for view in chosen:
        original = next(each for each in whole.views if each.image == view.image.resolve())
        np.testing.assert_allclose(view.camera.viewmat, original.camera.viewmat, atol=1e-12)
    # Those points are left that two of the nine see, with the observations of these alone.
    places = {whole.views.index(train[number]) for number in numbers}
    assert whole.point_views is not None
    tracks = np.split(whole.point_views.views, whole.point_views.offsets[1:-1])
    expected = [at for at, track in enumerate(tracks) if len(places & set(track.tolist())) >= 2]
    assert 0 < len(expected) < POINTS
    assert scene.track_lengths is not None
    lengths = [len(places & set(tracks[at].tolist())) for at in expected]
    # COLMAP keeps no order of points.
    order, originals = np.argsort(scene.points[:, 0]), np.argsort(whole.points[expected, 0])
    np.testing.assert_allclose(scene.points[order], whole.points[expected][originals], atol=1e-12)
    assert scene.track_lengths[order].tolist() == np.array(lengths)[originals].tolist()


def test_another_number_of_photos_is_refused(few: Any, whole: Scene, tmp_path: Path) -> None:
    train, test = split_views(whole, TrainOptions(holdout=5))
    with pytest.raises(ValueError, match="and 7 held-out ones; the whole scene has 20 and 5"):
        few.make("fox-9", tmp_path / "capture", whole, train, test)
    with pytest.raises(ValueError, match="has 9 and 5"):
        few.make("synthetic-9", tmp_path / "capture", whole, train[:9], test)
    assert not (tmp_path / "capture").exists()

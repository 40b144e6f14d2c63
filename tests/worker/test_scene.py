"""Proves the held-out split and that the normalising similarity changes no picture and can be undone.

Not proven here: how well a normalised scene trains.
"""

from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Camera, Normalization, Scene, View, split


def scene_of(names: list[str], offset: float = 0.0, splits: dict[str, str] | None = None) -> Scene:
    random = np.random.default_rng(0)
    views = []
    for name in names:
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
        viewmat[:3, 3] = -viewmat[:3, :3] @ (random.normal(size=3) * 5.0 + offset)
        camera = Camera(100, 80, 90.0, 91.0, 50.0, 40.0, viewmat)
        views.append(View(name, camera, Path(name), split=(splits or {}).get(name)))  # type: ignore[arg-type]
    points = random.normal(size=(50, 3)) * 20.0 + offset
    return Scene(tuple(views), points, np.zeros((50, 3), np.uint8), "sfm")


def names(views: tuple[View, ...]) -> list[str]:
    return [view.name for view in views]


def test_every_eighth_by_name_is_held_out() -> None:
    all_names = [f"{index:02d}" for index in range(17)]
    train, test = split(scene_of(all_names[::-1]), 8)
    assert names(test) == ["00", "08", "16"]
    assert names(train) == [name for name in all_names if name not in ("00", "08", "16")]


def test_zero_holds_none_out_and_one_is_refused() -> None:
    scene = scene_of(["a", "b", "c"])
    assert names(split(scene, 0)[0]) == ["a", "b", "c"]
    with pytest.raises(ValueError, match="every view"):
        split(scene, 1)


def test_a_data_sets_own_split_wins() -> None:
    scene = scene_of(["a", "b", "c"], splits={"a": "train", "b": "test", "c": "train"})
    train, test = split(scene, 2)
    assert (names(train), names(test)) == (["a", "c"], ["b"])
    assert names(split(scene, 0)[0]) == ["a", "c"]


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_normalisation_keeps_every_picture_and_is_undone(offset: float) -> None:
    scene = scene_of(["a", "b", "c", "d"], offset)
    frame = Normalization.of(scene)
    world = frame.apply(scene)
    assert np.linalg.norm(world.centers, axis=1).max() < 1.5
    for before, after in zip(scene.views, world.views, strict=True):
        pixels = [
            (camera.K @ (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T).T
            for camera, points in ((before.camera, scene.points), (after.camera, world.points))
        ]
        # float64 keeps 16 digits; at 5e6 from the origin 9 of them are left for a scene 100 across.
        np.testing.assert_allclose(
            pixels[0][:, :2] / pixels[0][:, 2:], pixels[1][:, :2] / pixels[1][:, 2:], rtol=1e-5, atol=1e-4
        )
        np.testing.assert_allclose(frame.undo_camera(after.camera).center, before.camera.center, atol=1e-7)
    np.testing.assert_allclose(frame.undo_points(world.points), scene.points, atol=1e-7)


def test_a_scene_whose_cameras_do_not_spread_gets_its_scale_from_the_points() -> None:
    scene = scene_of(["a"])
    assert 0.001 < Normalization.of(scene).scale < 1.0

"""Proves the cameras' geometry, the held-out split, and that the normalising similarity changes no picture and can be
undone.

Not proven here: lens distortion (`test_images`), and how well a normalised scene trains.
"""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from splatmill_worker.scene import Camera, Normalization, Scene, View, looked_at, omissions, split, viewmat_of

Split = Literal["train", "test"]


def scene_of(names: list[str], offset: float = 0.0, splits: dict[str, Split] | None = None) -> Scene:
    random = np.random.default_rng(0)
    views = []
    for name in names:
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
        viewmat[:3, 3] = -viewmat[:3, :3] @ (random.normal(size=3) * 5.0 + offset)
        camera = Camera(100, 80, 90.0, 91.0, 50.0, 40.0, viewmat)
        views.append(View(name, camera, Path(name), split=(splits or {}).get(name)))
    points = random.normal(size=(50, 3)) * 20.0 + offset
    return Scene(tuple(views), points, np.zeros((50, 3), np.uint8), "sfm")


def test_points_fall_where_the_intrinsic_matrix_puts_them() -> None:
    camera = scene_of(["a"]).views[0].camera
    points = np.random.default_rng(1).normal(size=(500, 3)) * 30.0
    homogeneous = camera.K @ (camera.viewmat @ np.c_[points, np.ones(500)].T)[:3]
    ahead = homogeneous[2] > 0
    columns, rows, depths, inside = camera.project(points)
    np.testing.assert_allclose(columns[ahead], homogeneous[0, ahead] / homogeneous[2, ahead], rtol=1e-9)
    np.testing.assert_allclose(rows[ahead], homogeneous[1, ahead] / homogeneous[2, ahead], rtol=1e-9)
    np.testing.assert_allclose(depths, homogeneous[2], rtol=1e-9, atol=1e-12)
    assert np.isnan(columns[~ahead]).all()
    within = (columns >= 0) & (columns < 100) & (rows >= 0) & (rows < 80)
    np.testing.assert_array_equal(inside, within & ahead)
    assert 0 < inside.sum() < ahead.sum() < 500


def test_unprojecting_undoes_projecting() -> None:
    camera = scene_of(["a"], offset=40.0).views[0].camera
    random = np.random.default_rng(2)
    points = camera.to_world(random.uniform((-3.0, -3.0, 0.1), (3.0, 3.0, 9.0), (50, 3)))
    projection = camera.project(points)
    np.testing.assert_allclose(
        camera.unproject(projection.columns, projection.rows, projection.depths), points, rtol=1e-12
    )
    np.testing.assert_allclose(camera.to_world(camera.to_camera(points)), points, rtol=1e-12)


def test_points_without_a_position_are_not_inside() -> None:
    camera = Camera(100, 80, 90.0, 91.0, 50.0, 40.0, np.eye(4))
    strange = [[np.nan, 0.0, 1.0], [0.0, 0.0, np.inf], [np.inf, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    assert not camera.project(np.array(strange)).inside.any()
    border = [[-50 / 90, 0.0, 1.0], [50 / 90, 0.0, 1.0], [-50.01 / 90, 0.0, 1.0], [0.0, 0.0, 1e-3]]
    assert camera.project(np.array(border)).inside.tolist() == [True, False, False, True]


def test_a_moved_camera_keeps_its_direction() -> None:
    camera = scene_of(["a"]).views[0].camera
    moved = camera.moved_to(np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(moved.center, [1.0, -2.0, 3.0], atol=1e-12)
    np.testing.assert_array_equal(moved.axis, camera.axis)
    np.testing.assert_allclose(viewmat_of(camera.viewmat[:3, :3], camera.center), camera.viewmat, atol=1e-12)


def test_what_cameras_look_at_is_where_their_axes_meet() -> None:
    centers = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]]) + 7.0
    np.testing.assert_allclose(looked_at(centers, 7.0 - centers), 7.0, atol=0.01)
    np.testing.assert_allclose(looked_at(centers, 7.0 - centers, ridge=0.0), 7.0, atol=1e-12)
    parallel = np.tile([0.0, 0.0, 2.0], (3, 1))
    np.testing.assert_allclose(looked_at(centers, parallel), centers.mean(axis=0), atol=1e-9)
    with pytest.raises(np.linalg.LinAlgError):
        looked_at(centers, parallel, ridge=0.0)


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


def test_a_scene_whose_cameras_do_not_spread_gets_its_scale_from_the_points() -> None:
    scene = scene_of(["a"])
    assert 0.001 < Normalization.of(scene).scale < 1.0


def test_files_left_out_for_one_reason_have_one_sentence() -> None:
    depth = [(f"{k}.depth.png", "no camera is given for it") for k in range(30)]
    assert omissions([("a.jpg", "the file is empty."), *depth]) == [
        "a.jpg is left out: the file is empty.",
        "0.depth.png and 29 more are left out: no camera is given for it.",
    ]
    assert len(omissions(depth[:3])) == 3

"""Proves in which way photos with an EXIF orientation are read where cameras are given: by the size of the camera, and
where that fits both ways, by the matches; and that nothing is guessed where these do not decide.

Does not prove what training gains.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Refusal
from splatmill_worker.images.decode import UPRIGHT
from splatmill_worker.images.load import load_view
from splatmill_worker.scene import Camera, Scene, viewmat_of
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed.judged import orientation
from splatmill_worker.sfm.posed.judged.searched import database_of, epipolar_errors, model_of
from splatmill_worker.sfm.sift import Features
from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.support.posed_sets import frame_of

STORED = UPRIGHT | {6: UPRIGHT[8], 8: UPRIGHT[6]}
"""What makes a stored photo of an upright one, of each EXIF orientation: the inverse of UPRIGHT."""

LAST = 8
"""Photos of a part of an orbit."""


@cache
def pictures(width: int, height: int) -> list[tuple[Camera, np.ndarray]]:
    life = still_life(0)
    cameras = orbit(2 * LAST, width, height)[:LAST]
    return [(camera, photograph(life, camera, samples=1)[0]) for camera in cameras]


def capture(
    folder: Path,
    size: tuple[int, int],
    tags: list[int],
    *,
    upright: bool,
    plain: bool = False,
    sized: bool = True,
) -> Scene:
    """The scene of photos with these orientations, none of 1, in turn, and of cameras of upright or of stored pixels.

    plain: photos of one colour. sized: write the size of the cameras.
    """
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, (camera, rgb) in enumerate(pictures(*size)):
        tag = tags[index % len(tags)]
        photo = Image.new("RGB", size, (90, 90, 90)) if plain else Image.fromarray(rgb)
        exif = Image.Exif()
        exif[0x0112] = tag
        turn = STORED.get(tag) if upright else None
        stored = photo if turn is None else photo.transpose(turn)
        stored.save(folder / "images" / f"{index}.png", exif=exif)
        lens = {"fl_x": camera.fx, "fl_y": camera.fy}
        if sized:
            lens |= {"w": camera.width, "h": camera.height, "cx": camera.cx, "cy": camera.cy}
        frames.append(frame_of(f"{index}.png", camera.viewmat, **lens))
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    poses = posed.find(folder)
    assert poses is not None
    return poses.load()


def check(scene: Scene, size: tuple[int, int]) -> None:
    """Every photo is loaded as the camera saw it."""
    assert len(scene.views) == LAST
    for view, (camera, rgb) in zip(scene.views, pictures(*size), strict=True):
        assert view.other is None
        assert (view.camera.width, view.camera.height) == size
        np.testing.assert_allclose(view.camera.K, camera.K, atol=1e-9)
        np.testing.assert_array_equal(load_view(view, max(size)).rgb, rgb)


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("tag", [6, 8, 5, 7])
def test_the_size_decides_where_it_can(tmp_path: Path, tag: int, upright: bool) -> None:
    scene = capture(tmp_path, (64, 48), [1, tag], upright=upright)
    check(scene, (64, 48))
    assert orientation.decided(scene) is scene


@pytest.mark.slow
@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize(
    ("size", "tags"),
    [
        ((288, 216), [1, 3]),  # some photos upside down
        ((288, 216), [3]),  # all
        ((288, 216), [1, 2]),  # mirrored, which features of SIFT do not match
        ((240, 240), [1, 6, 8]),  # square photos of a phone
    ],
)
def test_the_matches_decide_where_the_size_fits_both_ways(
    tmp_path: Path, size: tuple[int, int], tags: list[int], upright: bool
) -> None:
    scene = capture(tmp_path, size, tags, upright=upright)
    assert any(view.other is not None for view in scene.views)
    scene = orientation.decided(scene)
    check(scene, size)
    (warning,) = scene.warnings
    assert warning.endswith(f"so the photos are read {orientation.READINGS[upright]}.")


@pytest.mark.slow
@pytest.mark.parametrize("upright", [True, False])
def test_the_matches_decide_where_cameras_have_no_size(tmp_path: Path, upright: bool) -> None:
    scene = orientation.decided(capture(tmp_path, (288, 216), [6, 1], upright=upright, sized=False))
    check(scene, (288, 216))


def test_what_nothing_decides_is_left_out_or_refused(tmp_path: Path) -> None:
    """Plain photos have no matches."""
    scene = capture(tmp_path / "some", (64, 48), [1, 3], upright=True, plain=True)
    left = orientation.decided(scene)
    assert {view.name for view in left.views} == {"0.png", "2.png", "4.png", "6.png"}
    assert {name for name, _ in left.left_out} == {"1.png", "3.png", "5.png", "7.png"}
    assert "the matches do not decide" in left.warnings[0]
    assert all(reading in left.warnings[0] for reading in orientation.READINGS)
    with pytest.raises(Refusal, match="the matches do not decide") as error:
        orientation.decided(capture(tmp_path / "all", (64, 48), [3], upright=True, plain=True))
    assert error.value.code == "poses_invalid"


def test_points_keep_their_other_tracks_where_a_photo_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = (
        1,
        1,
        5,
        30,
    )
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse").mkdir()
    model.write_text(tmp_path / "sparse")
    size = next((camera.width, camera.height) for camera in model.cameras.values())
    names = sorted(image.name for image in model.images.values())
    for name in names:
        exif = Image.Exif()
        exif[0x0112] = 3 if name == names[1] else 1
        Image.new("RGB", size).save(tmp_path / "images" / name, exif=exif)
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = orientation.decided(poses.load())
    (tmp_path / "images" / names[1]).unlink()
    expected = poses.load()
    assert [view.name for view in scene.views] == [view.name for view in expected.views]
    np.testing.assert_array_equal(scene.points, expected.points)
    assert scene.point_views is not None
    assert expected.point_views is not None
    for ours, theirs in zip(scene.point_views, expected.point_views, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(scene.track_lengths, expected.track_lengths)


def test_points_behind_the_cameras_show_that_all_photos_are_upside_down(tmp_path: Path) -> None:
    """Cameras that only move sideways have the same epipolar lines if all photos are upside down."""
    points = np.random.default_rng(0).uniform((-1, -1, 4), (1, 1, 6), (40, 3))
    cameras = [
        Camera(200, 200, 150.0, 150.0, 100.0, 100.0, viewmat_of(np.eye(3), np.array([x, 0, 0])))
        for x in (0, 1)
    ]
    projections = [np.stack(camera.project(points)[:2], axis=1) for camera in cameras]
    matches = np.repeat(np.arange(40, dtype=np.uint32)[:, None], 2, axis=1)
    errors = []
    for name, places in (("right", projections), ("upside down", [200.0 - place for place in projections])):
        features = [
            Features(place, np.ones(40, np.float32), np.zeros((40, 128), np.uint8)) for place in places
        ]
        database = database_of(tmp_path / f"{name}.db", model_of(cameras), features)
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = matches
        database.write_two_view_geometry(1, 2, geometry)
        errors.append(
            [
                epipolar_errors([(0, 1)], cameras, features, database, in_front=front)
                for front in (False, True)
            ]
        )
        database.close()
    (plain, front), (turned_plain, turned_front) = errors
    assert max(plain.max(), front.max(), turned_plain.max()) < 1e-9
    assert np.isinf(turned_front).all()

"""Proves that the faces of a panorama show what pinhole cameras at their places would, also at its seam and its poles;
that masks and alpha are cut with it; and that points, masks and panoramas survive the way to faces and back.

The reference is the ray caster. Its pictures differ from faces by the resampling of both.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.images.load import load_view, load_views
from splatmill_worker.images.panoramas import faces
from splatmill_worker.scene import Camera, Lens, PointViews, Scene, View
from splatmill_worker.synthetic.ray_caster import picture
from tests.support import panoramas
from tests.support.scenes.photos import psnr

WIDTH = 256


def whole(path: Path, viewmat: np.ndarray, width: int = WIDTH) -> View:
    focal = width / (2 * np.pi)
    camera = Camera(width, width // 2, focal, focal, width / 2, width / 4, viewmat)
    return View(path.name, camera, path, lens=Lens(PANORAMA, (width, width / 2), width, width // 2))


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> View:
    """A panorama of the room."""
    folder = tmp_path_factory.mktemp("panorama")
    (pose,) = panoramas.walk(1)
    panoramas.write(folder, [pose], WIDTH, samples=1)
    return whole(folder / "pano_00.jpg", pose)


@pytest.mark.parametrize("name", faces.FACES)
def test_a_face_shows_what_a_pinhole_camera_there_sees(view: View, name: str) -> None:
    (face,) = (each for each in faces.faces_of(view) if each.name == f"pano_00.jpg/{name}")
    photo = load_view(face, 1000)
    assert photo.rgb.shape == (64, 64, 3)
    assert psnr(photo.rgb, picture(panoramas.room(), photo.camera, 2)) > 30
    small = load_view(face, 20)
    assert psnr(small.rgb, picture(panoramas.room(), small.camera, 4)) > 26


def test_the_seam_is_interpolated_across(tmp_path: Path) -> None:
    """A smooth ramp that closes at the seam stays smooth in the face that shows it."""
    longitude = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi
    ramp = np.repeat((128 + 100 * np.cos(longitude))[None], WIDTH // 2, 0).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "a.png")
    back = next(f for f in faces.faces_of(whole(tmp_path / "a.png", np.eye(4))) if f.name.endswith("back"))
    row = load_view(back, 1000).rgb[32, :, 0].astype(int)
    assert np.abs(np.diff(row, 2)).max() <= 2
    assert np.flatnonzero(row == row.max()).mean() == pytest.approx(31.5, abs=1)


def test_masks_and_alpha_of_a_panorama_are_cut_with_it(tmp_path: Path) -> None:
    pixels = np.zeros((WIDTH // 2, WIDTH, 4), np.uint8)
    pixels[:, :, 0], pixels[:, :, 3] = 200, 255
    pixels[: WIDTH // 6, :, 3] = 0  # transparent above 30 degrees
    Image.fromarray(pixels).save(tmp_path / "a.png")
    hidden = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    hidden[WIDTH // 3 :] = 0  # hidden below -30 degrees
    Image.fromarray(hidden).save(tmp_path / "mask.png")
    view = replace(whole(tmp_path / "a.png", np.eye(4)), mask=tmp_path / "mask.png")
    loaded = {photo.view.name[6:]: photo for photo in load_views(faces.faces_of(view), 1000)}
    assert loaded["down"].mask is not None
    assert loaded["front"].mask is not None
    assert not loaded["down"].mask.any()
    assert loaded["front"].mask[32].all()
    row = 32 + 32 * np.tan(np.radians(30))  # in the middle column
    np.testing.assert_allclose(loaded["front"].mask[:, 32].sum(), row, atol=1)
    assert loaded["up"].alpha is not None
    assert loaded["front"].alpha is not None
    assert loaded["up"].alpha.max() == 0
    assert loaded["front"].alpha[32].min() == 255
    assert (loaded["front"].rgb[32, :, 0] == 200).all()


def test_points_go_to_the_face_that_shows_them_and_back(tmp_path: Path) -> None:
    poses = panoramas.walk(3)
    views = [whole(tmp_path / f"{k}.jpg", pose) for k, pose in enumerate(poses)]
    ordinary = View("b.jpg", Camera(64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / "b.jpg")
    points = np.random.default_rng(0).normal(size=(200, 3)) * 3
    numbers = np.tile(np.array([0, 2, 3], np.int32), 200)
    tracks = PointViews(np.arange(0, 601, 3), numbers)
    scene = Scene((*views, ordinary), points, np.zeros((200, 3), np.uint8), "colmap", point_views=tracks)
    cut = faces.cut(scene)
    assert len(cut.views) == 3 * 6 + 1
    assert cut.point_views is not None
    for point in range(200):
        for number in cut.point_views.views[3 * point : 3 * point + 2]:
            assert cut.views[number].camera.project(points[point : point + 1]).inside.all()
        assert cut.views[cut.point_views.views[3 * point + 2]] is ordinary
    back = faces.joined(cut)
    assert [each.name for each in back.views] == ["0.jpg", "1.jpg", "2.jpg", "b.jpg"]
    for one, other in zip(back.views, scene.views, strict=True):
        np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-12)
        assert (one.lens, one.camera.fx, one.camera.width) == (
            other.lens,
            other.camera.fx,
            other.camera.width,
        )
    assert back.point_views is not None
    np.testing.assert_array_equal(back.point_views.offsets, tracks.offsets)
    np.testing.assert_array_equal(back.point_views.views, numbers)


def test_scenes_without_panoramas_are_left_as_they_are() -> None:
    scene = Scene((), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "sfm")
    assert faces.cut(scene) is scene
    assert faces.joined(scene) is scene

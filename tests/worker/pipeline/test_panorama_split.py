"""Proves that panoramas are held out whole, that a near copy of a held-out one is left out however it is turned, that a
photo from its place is too, and that cameras.zip gives the panoramas back."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.images.panoramas import faces
from splatmill_worker.pipeline.holdout.split import honest_split
from splatmill_worker.scene import Camera, Lens, PointViews, Scene, View, viewmat_of
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed.written import write_cameras
from tests.support.panoramas import striped, walk

OPTIONS = TrainOptions()


def panorama(path: Path, viewmat: np.ndarray) -> View:
    camera = Camera(512, 256, 512 / (2 * np.pi), 512 / (2 * np.pi), 256, 128, viewmat)
    return View(path.name, camera, path, lens=Lens(PANORAMA, (512.0, 256.0), 512, 256))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Ten panoramas round points that all of them see, as faces."""
    views = []
    for number, pose in enumerate(walk(10)):
        path = tmp_path / "images" / f"{number:02d}.jpg"
        striped(path, seed=number)
        views.append(panorama(path, pose))
    points = np.random.default_rng(1).uniform(-6, 6, (300, 3))
    tracks = PointViews(np.arange(0, 3001, 10), np.tile(np.arange(10, dtype=np.int32), 300))
    return faces.cut(Scene(tuple(views), points, np.zeros((300, 3), np.uint8), "sfm", point_views=tracks))


def names(views: tuple[View, ...]) -> list[str]:
    return [view.name for view in views]


def beside(view: View, path: Path, shift: float, degrees: float) -> View:
    """A panorama moved along x, and turned about its vertical, with a picture of its own."""
    whole = faces.whole_of(view)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    camera = replace(
        whole.camera,
        viewmat=viewmat_of(
            turn @ whole.camera.viewmat[:3, :3], whole.camera.center + np.array([shift, 0, 0])
        ),
    )
    striped(path, seed=99)
    return replace(whole, name=path.name, image=path, camera=camera)


def with_view(scene: Scene, view: View) -> Scene:
    return replace(scene, views=(*scene.views, *faces.faces_of(view)), point_views=None)


def test_panoramas_are_held_out_with_all_of_their_faces(scene: Scene) -> None:
    parts = honest_split(faces.joined(scene), OPTIONS)
    assert names(parts.held_out) == ["00.jpg", "08.jpg"]
    assert len(parts.training) == 8
    assert (parts.left_out, parts.warnings) == ((), ())
    named = honest_split(faces.joined(scene), TrainOptions(test_views=("03.jpg",)))
    assert names(named.held_out) == ["03.jpg"]


@pytest.mark.parametrize(("shift", "degrees"), [(0.0, 45.0), (0.003, 170.0), (0.003, 0.0)])
def test_a_near_copy_is_found_however_it_is_turned(
    scene: Scene, tmp_path: Path, shift: float, degrees: float
) -> None:
    near = beside(scene.views[0], tmp_path / "images/00b.jpg", shift, degrees)
    parts = honest_split(faces.joined(with_view(scene, near)), OPTIONS)
    assert parts.left_out == (("00b.jpg", "it is nearly the same as 00.jpg, which is held out"),)
    assert "00b.jpg" not in names(parts.training)


def test_a_step_aside_is_trained_on(scene: Scene, tmp_path: Path) -> None:
    step = beside(scene.views[0], tmp_path / "images/00b.jpg", 0.2, 0.0)
    parts = honest_split(faces.joined(with_view(scene, step)), OPTIONS)
    assert parts.left_out == ()
    assert "00b.jpg" in names(parts.training)


def test_an_ordinary_photo_from_the_place_of_a_held_out_panorama_is_left_out(
    scene: Scene, tmp_path: Path
) -> None:
    place = scene.views[0].camera
    path = tmp_path / "images/00b.jpg"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)).save(path)
    photo = View("00b.jpg", Camera(64, 48, 60.0, 60.0, 32.0, 24.0, place.viewmat), path)
    parts = honest_split(faces.joined(with_view(scene, photo)), OPTIONS)
    assert parts.left_out == (("00b.jpg", "it is nearly the same as 00.jpg, which is held out"),)


@pytest.mark.parametrize("form", ["sparse", "transforms.json"])
def test_cameras_zip_gives_the_panoramas_back(scene: Scene, tmp_path: Path, form: str) -> None:
    write_cameras(tmp_path / "c.zip", scene, {}, np.zeros(3), frozenset({"00.jpg/front", "00.jpg/up"}))
    with zipfile.ZipFile(tmp_path / "c.zip") as archive:
        archive.extractall(
            tmp_path / "poses", [name for name in archive.namelist() if name.startswith((form, "points"))]
        )
    source = posed.find(tmp_path)
    assert source is not None
    read = faces.cut(source.load())
    assert [view.name for view in read.views] == [view.name for view in scene.views]
    for mine, theirs in zip(read.views, scene.views, strict=True):
        np.testing.assert_allclose(mine.camera.viewmat, theirs.camera.viewmat, atol=1e-9)
        np.testing.assert_allclose(mine.camera.K, theirs.camera.K)
    assert {view.photo for view in read.views if view.split == "test"} == (
        {"00.jpg"} if form == "transforms.json" else set()
    )

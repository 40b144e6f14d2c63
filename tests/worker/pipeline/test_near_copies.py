"""Proves that no photo is trained on that was taken from nearly the same place as a held-out one, however the camera
was turned; that copies are used once; and that photos a step apart keep the split as it is.

Not proven here: how well a scene trains on what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.images.overlays import overlays
from splatmill_worker.pipeline.holdout.split import honest_split, split_views
from splatmill_worker.scene import Camera, Scene, View, viewmat_of
from splatmill_worker.synthetic import photograph
from splatmill_worker.synthetic import still_life as built_in
from tests.support import still_life
from tests.worker.images.test_copies import compressed, exposed

OPTIONS = TrainOptions()


def names(views: tuple[View, ...]) -> list[str]:
    return [view.name for view in views]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """The still life from sides that are 26 degrees apart, with its photos."""
    made = still_life.scene()
    views = []
    for view, (_, rgb, _) in zip(made.views, still_life.pictures(), strict=True):
        Image.fromarray(rgb).save(tmp_path / view.name)
        views.append(replace(view, image=tmp_path / view.name))
    return replace(made, views=tuple(views))


def beside(view: View, name: str, shift: float, degrees: float = 0.0) -> View:
    """A view moved sideways by a share of its distance from the origin, and turned about its vertical."""
    camera = view.camera
    rotation = camera.viewmat[:3, :3]
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    center = camera.center + shift * float(np.linalg.norm(camera.center)) * rotation[0]
    return replace(view, name=name, camera=replace(camera, viewmat=viewmat_of(turn @ rotation, center)))


def test_photos_a_step_apart_keep_their_split(scene: Scene) -> None:
    parts = honest_split(scene, OPTIONS)
    assert (parts.training, parts.held_out) == split_views(scene, OPTIONS)
    assert (parts.left_out, parts.warnings) == ((), ())


@pytest.mark.parametrize(("shift", "degrees"), [(0.0, 0.0), (0.001, 0.0), (0.0, 2.0), (0.001, -2.0)])
def test_a_burst_of_a_held_out_photo_is_not_trained_on(
    scene: Scene, tmp_path: Path, shift: float, degrees: float
) -> None:
    burst = beside(scene.views[0], "00b.png", shift, degrees)
    noisy = np.random.default_rng(0).integers(0, 256, (72, 96, 3), np.uint8)
    Image.fromarray(noisy).save(tmp_path / "00b.png")
    burst = replace(burst, image=tmp_path / "00b.png")
    views = (*scene.views, burst)
    parts = honest_split(replace(scene, views=views, point_views=None), OPTIONS)
    assert parts.left_out == (("00b.png", "it is nearly the same as 00.png, which is held out"),)
    assert "00.png" in names(parts.held_out)
    assert "00b.png" not in names(parts.training)
    assert len(parts.training) + len(parts.held_out) == len(views) - 1
    assert "1 photo is not trained on" in parts.warnings[0]


def test_a_step_beside_a_held_out_photo_is_trained_on(scene: Scene, tmp_path: Path) -> None:
    step = replace(beside(scene.views[0], "00b.png", 0.03), image=tmp_path / "00b.png")
    Image.fromarray(photograph(built_in(0), step.camera, samples=1)[0]).save(step.image)
    views = (*scene.views, step)
    parts = honest_split(replace(scene, views=views, point_views=None), OPTIONS)
    assert "00b.png" in names(parts.training)


def test_a_smaller_copy_with_its_own_camera_is_used_once(scene: Scene, tmp_path: Path) -> None:
    smaller = []
    (tmp_path / "web").mkdir()
    for view in scene.views:
        path = tmp_path / "web" / view.name
        Image.open(view.image).resize((48, 36), Image.Resampling.LANCZOS).save(path)
        camera = view.camera.scaled_to(48, 36)
        smaller.append(replace(view, name=f"web/{view.name}", camera=camera, image=path))
    parts = honest_split(replace(scene, views=(*smaller, *scene.views), point_views=None), OPTIONS)
    assert (names(parts.training), names(parts.held_out)) == tuple(map(names, split_views(scene, OPTIONS)))
    assert dict(parts.left_out) == {f"web/{v.name}": f"it shows the same as {v.name}" for v in scene.views}


def enlarged(photo: Image.Image) -> Image.Image:
    width, height = photo.size
    return photo.crop((3, 3, width - 3, height - 3)).resize(photo.size, Image.Resampling.LANCZOS)


def vignetted(photo: Image.Image) -> Image.Image:
    y, x = np.mgrid[-1:1:72j, -1:1:96j]
    return Image.fromarray((np.asarray(photo) * (1.0 - 0.15 * (x * x + y * y))[..., None]).astype(np.uint8))


COPIES: dict[str, tuple[Callable[[Image.Image], Image.Image], float]] = {
    "exposed three stops longer": (exposed(3.0), 0.0),
    "exposed two stops shorter": (exposed(-2.0), 0.0),
    "compressed strongly": (compressed(25), 0.0),
    "cropped and enlarged": (enlarged, 0.0),
    "exposed longer, cropped and enlarged": (lambda photo: enlarged(exposed(1.5)(photo)), 0.0),
    "with darker corners": (vignetted, 0.0),
    "exposed longer, with a camera of its own": (exposed(1.5), 0.02),
    "exposed shorter, with a camera of its own": (exposed(-2.0), 0.02),
    "compressed, with a camera of its own": (compressed(60), 0.02),
}


@pytest.mark.parametrize(("change", "moved"), COPIES.values(), ids=COPIES.keys())
@pytest.mark.parametrize("original", [3, 0], ids=["of a training photo", "of a held-out photo"])
def test_one_copy_with_a_given_camera_is_found_by_its_content(
    scene: Scene, tmp_path: Path, original: int, change: Callable[[Image.Image], Image.Image], moved: float
) -> None:
    view = scene.views[original]
    copy = replace(beside(view, f"{view.name[:2]}_b.png", moved), image=tmp_path / "copy.png")
    change(Image.open(view.image).convert("RGB")).save(copy.image)
    parts = honest_split(replace(scene, views=(*scene.views, copy), point_views=None), OPTIONS)
    assert (names(parts.training), names(parts.held_out)) == tuple(map(names, split_views(scene, OPTIONS)))
    assert parts.left_out == ((copy.name, f"it shows the same as {view.name}"),)
    assert f"{copy.name}, a copy of {view.name}" in parts.warnings[0]


def test_of_an_exposure_series_with_cameras_the_photo_with_the_fewest_clipped_pixels_is_kept(
    scene: Scene, tmp_path: Path
) -> None:
    """Those that come before it in order of name are longer or shorter exposures."""
    series = []
    for index, stops in enumerate((2.0, -3.0)):
        copy = replace(scene.views[3], name=f"02_{index}.png", image=tmp_path / f"02_{index}.png")
        exposed(stops)(Image.open(scene.views[3].image).convert("RGB")).save(copy.image)
        series.append(copy)
    parts = honest_split(replace(scene, views=(*series, *scene.views), point_views=None), OPTIONS)
    assert parts.left_out == tuple((copy.name, "it shows the same as 03.png") for copy in series)


@pytest.mark.parametrize(("count", "trained", "held"), [(1, 1, 0), (2, 2, 0), (3, 2, 1), (4, 3, 1)])
def test_few_photos_are_a_warning_and_of_two_none_is_held_out(
    scene: Scene, count: int, trained: int, held: int
) -> None:
    parts = honest_split(replace(scene, views=scene.views[:count], point_views=None), OPTIONS)
    assert (len(parts.training), len(parts.held_out)) == (trained, held)
    said = [warning for warning in parts.warnings if "trained on" in warning]
    assert bool(said) == (trained < 3)
    assert all(f"Only {trained} photo" in warning and "Give more photos" in warning for warning in said)


def test_few_photos_that_a_split_leaves_are_a_warning(scene: Scene) -> None:
    held = TrainOptions(test_views=tuple(names(scene.views[1:])))
    parts = honest_split(scene, held)
    assert len(parts.training) == 1
    assert "Only 1 photo is trained on" in parts.warnings[-1]
    assert "hold out fewer" in parts.warnings[-1]


@pytest.mark.parametrize("held", ["00.png", "copy.png"])
def test_a_brighter_copy_across_a_given_split_is_not_trained_on(
    scene: Scene, tmp_path: Path, held: str
) -> None:
    copy = replace(beside(scene.views[0], "copy.png", 0.02), image=tmp_path / "copy.png")
    exposed(1.0)(Image.open(scene.views[0].image).convert("RGB")).save(copy.image)
    views = (*scene.views, copy)
    options = TrainOptions(test_views=(held,))
    parts = honest_split(replace(scene, views=views, point_views=None), options)
    other = ({"00.png", "copy.png"} - {held}).pop()
    assert names(parts.held_out) == [held]
    assert parts.left_out == ((other, f"it is nearly the same as {held}, which is held out"),)


def test_a_test_photo_of_the_data_set_keeps_its_side(scene: Scene) -> None:
    test = replace(scene.views[3], name="a.png", split="test")
    parts = honest_split(replace(scene, views=(*scene.views, test), point_views=None), OPTIONS)
    assert names(parts.held_out) == ["a.png"]
    assert parts.left_out == (("03.png", "it is nearly the same as a.png, which is held out"),)


def test_a_copy_of_a_given_test_photo_is_not_trained_on(scene: Scene) -> None:
    test = replace(scene.views[0], split="test")
    views = [replace(view, split="train") for view in scene.views[1:]]
    copied = replace(test, name="again.png", split="train")
    parts = honest_split(replace(scene, views=(test, *views, copied), point_views=None), OPTIONS)
    assert names(parts.held_out) == ["00.png"]
    assert "again.png" not in names(parts.training)


def line(count: int, step: float) -> Scene:
    """Cameras on a line, with points at a distance of 1 before them."""
    views = tuple(
        View(
            f"{k:03d}.png",
            Camera(100, 80, 100.0, 100.0, 50.0, 40.0, viewmat_of(np.eye(3), np.array([k * step, 0.0, 0.0]))),
            Path(f"{k:03d}.png"),
        )
        for k in range(count)
    )
    points = np.random.default_rng(0).uniform((-0.3, -0.3, 0.95), (0.3 + count * step, 0.3, 1.05), (400, 3))
    return Scene(views, points, np.zeros((400, 3), np.uint8), "sfm")


def test_of_a_slow_video_fewer_frames_are_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatmill_worker.pipeline.holdout.split.same_photos", lambda scene: {})
    parts = honest_split(line(128, 0.0006), OPTIONS)
    assert 1 < len(parts.held_out) < 16
    places = np.array([view.camera.center[0] for view in parts.training])
    for view in parts.held_out:
        assert np.abs(places - view.camera.center[0]).min() > 0.0029
    assert len(parts.training) > 32
    assert "th photo is held out, since so many are alike" in parts.warnings[0]


def test_photos_from_one_place_are_kept_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatmill_worker.pipeline.holdout.split.same_photos", lambda scene: {})
    scene = line(16, 0.00001)
    parts = honest_split(scene, OPTIONS)
    assert (parts.training, parts.held_out) == split_views(scene, OPTIONS)
    assert "the held-out PSNR says little about other views" in parts.warnings[0]


def test_a_logo_is_masked_where_cameras_are_given(scene: Scene, tmp_path: Path) -> None:
    pattern = np.random.default_rng(1).integers(0, 2, (4, 12)).repeat(2, 0).repeat(2, 1) * 255
    for view in scene.views:
        rgb = np.asarray(Image.open(view.image)).copy()
        rgb[60:68, 4:28] = pattern[..., None]
        Image.fromarray(rgb).save(view.image)
    masked = overlays.in_views(scene, tmp_path / "work")
    (path,) = {view.mask for view in masked.views}
    assert path is not None
    mask = np.asarray(Image.open(path))
    assert (mask[64, 16], mask[20, 60]) == (0, 255)
    assert "at the bottom left, never changes in 14 photos" in masked.warnings[-1]

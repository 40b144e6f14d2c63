"""Proves that the faces of a wide lens show what pinhole cameras at their places would, also beside and behind the
camera; that no face is made of what a lens hardly sees; and that masks and points survive the way to faces and back.

The reference is the ray caster. Its pictures differ from faces by the resampling of both.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images import look_ups
from splatmill_worker.images.lens import pinhole, remarks
from splatmill_worker.images.load import load_view, load_views
from splatmill_worker.images.panoramas import faces
from splatmill_worker.scene import Lens, PointViews, Scene, View
from splatmill_worker.synthetic.ray_caster import picture
from tests.support import panoramas
from tests.support.scenes.photos import psnr

FOCAL = 60.0


def of_lens(path: Path, degrees: float, viewmat: np.ndarray, scale: int = 1) -> View:
    """A photo of an equidistant lens whose circle fills it, with a camera `scale` times the size of the lens."""
    side = 2 * round(FOCAL * np.radians(degrees) / 2)
    params = FOCAL, FOCAL, side / 2, side / 2, 0.0, 0.0, 0.0, 0.0
    lens = Lens("OPENCV_FISHEYE", params, side, side, limit=np.radians(degrees) / 2)
    camera = pinhole(lens, viewmat)
    return View(path.name, camera.scaled_to(scale * side, scale * side), path, lens=lens)


def written(path: Path, degrees: float, scale: int = 1) -> View:
    (pose,) = panoramas.walk(1)
    view = of_lens(path, degrees, pose, scale)
    size = view.camera.width, view.camera.height
    Image.fromarray(panoramas.fisheye(panoramas.room(), pose, size, FOCAL * scale, degrees, samples=1)).save(
        path
    )
    return view


@pytest.mark.parametrize(("degrees", "scale"), [(150.0, 1), (185.0, 2), (240.0, 1)])
def test_a_face_shows_what_a_pinhole_camera_there_sees(tmp_path: Path, degrees: float, scale: int) -> None:
    view = written(tmp_path / "a.png", degrees, scale)
    divided = faces.faces_of(view)
    assert [face.name for face in divided] == [
        f"a.png/{name}" for name in ("front", "right", "left", "up", "down")
    ]
    for face in divided:
        for size in (1000, 30):
            photo = load_view(face, size)
            # Half a pixel of the photo from its dark frame.
            row, column = np.mgrid[: photo.camera.height, : photo.camera.width] + 0.5
            rays = np.stack([*photo.camera.normalized(column, row), np.ones(row.shape)], axis=-1)
            ahead = rays @ photo.camera.viewmat[:3, :3] @ view.camera.axis / np.linalg.norm(rays, axis=-1)
            margin = 1.5 / min(FOCAL * scale, photo.camera.fx)
            inside = np.arccos(ahead.clip(-1, 1)) < np.radians(degrees) / 2 - margin
            shown = np.ones(row.shape, bool) if photo.mask is None else photo.mask
            assert shown[inside].all()
            assert psnr(photo.rgb[inside], picture(panoramas.room(), photo.camera, 3)[inside]) > 28


def test_faces_are_cropped_to_what_the_lens_sees(tmp_path: Path) -> None:
    wide, narrow = (
        {face.name[2:]: face.camera for face in faces.faces_of(of_lens(tmp_path / "a", degrees, np.eye(4)))}
        for degrees in (240.0, 150.0)
    )
    side = wide["front"].width
    assert side == 2 * round(FOCAL * np.pi / 4)
    for cameras in (wide, narrow):
        sizes = {(cameras[name].width, cameras[name].height) for name in ("left", "right")}
        assert sizes == {(cameras[name].height, cameras[name].width) for name in ("up", "down")}
        assert {height for _, height in sizes} == {side}
    # The lens sees 75 degrees to the right: 15 less than the axis of the face there.
    assert narrow["right"].width == pytest.approx(side / 2 * (1.0 - np.tan(np.radians(15.0))), abs=2)
    # And 30 degrees more than it, in the corners of the face farther: a / sqrt(2 + a^2) is sin(30 degrees).
    assert wide["right"].width == pytest.approx(side / 2 * (1.0 + np.sqrt(2.0 / 3.0)), abs=2)


@pytest.mark.parametrize("degrees", [95.0, 120.0])
def test_a_lens_that_a_pinhole_nearly_shows_stays_one_view(tmp_path: Path, degrees: float) -> None:
    view = of_lens(tmp_path / "a.png", degrees, np.eye(4))
    assert not faces.is_divided(view)
    assert faces.faces_of(view) == (view,)
    assert bool(remarks([view.lens])) == (degrees > 100.0)


def test_masks_alpha_and_the_edge_of_the_photo_are_cut_with_it(tmp_path: Path) -> None:
    view = of_lens(tmp_path / "a.png", 180.0, np.eye(4))
    side = view.camera.width
    pixels = np.full((side, side, 4), 255, np.uint8)
    pixels[:, :, :3] = 200
    pixels[: side // 3, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    hidden = np.full((side, side), 255, np.uint8)
    hidden[:, : side // 2] = 0
    Image.fromarray(hidden).save(tmp_path / "mask.png")
    loaded = {
        photo.view.name[6:]: photo
        for photo in load_views(faces.faces_of(replace(view, mask=tmp_path / "mask.png")), 1000)
    }
    front, left, right, up = (loaded[name] for name in ("front", "left", "right", "up"))
    assert front.mask is not None
    np.testing.assert_array_equal(
        front.mask.mean(axis=0).round(), np.arange(front.camera.width) >= front.camera.cx
    )
    assert left.mask is not None
    assert not left.mask.any()
    assert right.mask is not None
    columns = np.arange(right.camera.width) + 0.5 - right.camera.cx
    clear = np.asarray(np.abs(columns) > 1)
    np.testing.assert_array_equal(np.asarray(right.mask.all(axis=0))[clear], columns[clear] < 0)
    assert up.alpha is not None
    assert up.alpha.max() == 0
    assert front.alpha is not None
    assert front.alpha[front.camera.height // 2 :].min() == 255
    assert (front.rgb[front.camera.height // 2 :] == 200).all()


def test_faces_of_many_photos_share_their_look_ups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each direction is computed once where the look-ups of two are not kept, and the photos come in their order."""
    views = [written(tmp_path / f"{number}.png", 185.0) for number in range(3)]
    divided = [face for view in views for face in faces.faces_of(view)]
    computed: list[object] = []
    compute = look_ups._computed
    monkeypatch.setattr(look_ups, "KEPT_BYTES", 1)

    def counted(*key: Any) -> look_ups.LookUp:
        computed.append(key)
        return compute(*key)

    monkeypatch.setattr(look_ups, "_computed", counted)
    photos = load_views(divided, 1000, threads=1)
    assert len(computed) == 5
    assert [photo.view.name for photo in photos] == [face.name for face in divided]
    for photo, face in zip(photos, divided, strict=True):
        np.testing.assert_array_equal(photo.rgb, load_view(face, 1000).rgb)


def test_a_photo_of_another_shape_is_refused_with_its_own_size(tmp_path: Path) -> None:
    view = of_lens(tmp_path / "a.png", 180.0, np.eye(4))
    Image.new("RGB", (view.camera.width, view.camera.width // 2)).save(tmp_path / "a.png")
    with pytest.raises(
        ValueError, match=rf"a different shape from the {view.camera.width} x {view.camera.width}"
    ):
        load_view(faces.faces_of(view)[1], 1000)


def test_points_go_to_a_face_and_back(tmp_path: Path) -> None:
    views = [of_lens(tmp_path / f"{k}.jpg", 240.0, pose, scale=2) for k, pose in enumerate(panoramas.walk(2))]
    points = np.random.default_rng(0).normal(size=(100, 3)) * 3
    tracks = PointViews(np.arange(0, 201, 2), np.tile(np.array([0, 1], np.int32), 100))
    scene = Scene(tuple(views), points, np.zeros((100, 3), np.uint8), "colmap", point_views=tracks)
    cut = faces.cut(scene)
    assert len(cut.views) == 10
    assert cut.notes == (
        "2 photos of a wide lens (OPENCV_FISHEYE) are trained as 10 faces, pinhole photos of up to 90 degrees with up "
        f"to {cut.views[0].camera.width} pixels on a side.",
    )
    assert cut.point_views is not None
    for view, own in zip(views, (cut.point_views.views[0::2], cut.point_views.views[1::2]), strict=True):
        ahead = (points - view.camera.center) @ view.camera.axis
        visible = ahead > -0.45 * np.linalg.norm(points - view.camera.center, axis=1)
        for point in np.flatnonzero(visible):
            assert cut.views[own[point]].camera.project(points[point : point + 1]).inside.all()
    back = faces.joined(cut)
    assert back.point_views is not None
    np.testing.assert_array_equal(back.point_views.views, tracks.views)
    for one, other in zip(back.views, views, strict=True):
        assert (one.name, one.lens, one.face) == (other.name, other.lens, None)
        np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-12)
        assert (one.camera.fx, one.camera.width) == (other.camera.fx, other.camera.width)

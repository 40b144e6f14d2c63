"""Proves that cameras.zip holds the cameras, points and tracks of a scene as COLMAP's own code reads them, and that our
readers make the same scene of it: with lenses, refined poses and an offset.

Not proven here: what nerfstudio makes of transforms.json; it is read as its documentation describes the file.
"""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Lens, PointViews, Scene, View, viewmat_of
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed.written import write_cameras

LENSES = (
    None,
    Lens("OPENCV", (60.0, 61.0, 31.0, 25.0, 0.05, -0.02, 0.001, 0.002), 64, 48),
    Lens("SIMPLE_RADIAL", (120.0, 64.0, 48.0, 0.03), 128, 96),  # of a photo of twice the size
    Lens("OPENCV_FISHEYE", (40.0, 41.0, 32.0, 24.0, 0.01, 0.002, -0.001, 0.0005), 64, 48),
    Lens("FULL_OPENCV", (60.0, 61.0, 31.0, 25.0, 0.05, -0.02, 0.001, 0.002, 0.003, 0.004, 0.0, 0.0), 64, 48),
)


def scene_in(capture: Path, lenses: tuple[Lens | None, ...] = LENSES) -> Scene:
    """Photos in images/ with random cameras, and 30 points, each seen by two of them."""
    random = np.random.default_rng(2)
    views = []
    for index, lens in enumerate(lenses):
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        viewmat = viewmat_of(rotation, random.normal(size=3) * 4)
        path = capture / "images" / f"day one/{index}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 48), (index, 0, 0)).save(path)
        camera = Camera(64, 48, 55.5, 56.5, 30.5, 24.5, viewmat)
        views.append(View(f"day one/{index}.png", camera, path, lens=lens))
    count = 30
    pairs = np.array([sorted(random.choice(len(views), 2, replace=False)) for _ in range(count)])
    return Scene(
        views=tuple(views),
        points=random.normal(size=(count, 3)),
        colors=random.integers(0, 256, (count, 3)).astype(np.uint8),
        source="sfm",
        point_errors=random.uniform(0.1, 1.0, count),
        track_lengths=np.full(count, 2, np.int32),
        point_views=PointViews(np.arange(0, 2 * count + 1, 2), pairs.flatten().astype(np.int32)),
    )


def unpacked(scene: Scene, folder: Path, held_out: frozenset[str] = frozenset()) -> Path:
    write_cameras(folder / "cameras.zip", scene, {}, np.zeros(3), held_out)
    with zipfile.ZipFile(folder / "cameras.zip") as archive:
        archive.extractall(folder / "poses")
    return folder / "poses"


def assert_same(actual: Scene, expected: Scene) -> None:
    """The same photos seen by the same cameras through the same lenses, and the same coloured points."""
    assert [view.name for view in actual.views] == [view.name for view in expected.views]
    for mine, theirs in zip(actual.views, expected.views, strict=True):
        np.testing.assert_allclose(mine.camera.viewmat, theirs.camera.viewmat, atol=1e-12)
        if theirs.lens is None:
            assert mine.lens is None
            np.testing.assert_allclose(mine.camera.K, theirs.camera.K, atol=1e-9)
        else:
            assert mine.lens is not None
            assert_same_lens(mine.lens, theirs.lens)
    order, other = (np.lexsort(scene.points.T) for scene in (actual, expected))
    np.testing.assert_allclose(actual.points[order], expected.points[other], atol=1e-12)
    np.testing.assert_array_equal(actual.colors[order], expected.colors[other])


def assert_same_lens(actual: Lens, expected: Lens) -> None:
    """Both project the same rays to the same places, in shares of the photo."""
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    rays[:, 2] = 1.0
    places = []
    for lens in (actual, expected):
        camera = pycolmap.Camera(
            model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
        )
        places.append(np.asarray(camera.img_from_cam(rays)) / (lens.width, lens.height))
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)


def test_the_colmap_model_is_read_back_as_the_same_scene(tmp_path: Path) -> None:
    scene = scene_in(tmp_path)
    folder = unpacked(scene, tmp_path)
    (folder / "transforms.json").unlink()
    poses = posed.find(tmp_path)
    assert poses is not None
    assert poses.source == "colmap"
    read = poses.load()
    assert_same(read, scene)
    assert read.point_views is not None
    assert scene.point_views is not None
    rows = {tuple(read.points[i]): read.point_views.views[2 * i : 2 * i + 2].tolist() for i in range(30)}
    assert rows == {
        tuple(scene.points[i]): scene.point_views.views[2 * i : 2 * i + 2].tolist() for i in range(30)
    }


def test_colmap_itself_reads_tracks_whose_places_are_the_projections(tmp_path: Path) -> None:
    scene = scene_in(tmp_path)
    model = pycolmap.Reconstruction(unpacked(scene, tmp_path) / "sparse/0")
    assert (model.num_reg_images(), model.num_points3D(), model.num_cameras()) == (5, 30, 5)
    checked = 0
    for point in model.points3D.values():
        assert point.track.length() == 2
        for element in point.track.elements:
            image = model.images[element.image_id]
            local = image.cam_from_world() * point.xyz
            if local[2] > 0.5:
                place = model.cameras[image.camera_id].img_from_cam(local)
                np.testing.assert_allclose(image.points2D[element.point2D_idx].xy, place, atol=1e-9)
                checked += 1
    assert checked > 10
    model.write_text(tmp_path)  # as text, too, it is a whole model
    assert pycolmap.Reconstruction(tmp_path).num_points3D() == 30


def test_transforms_json_is_read_back_as_the_same_scene(tmp_path: Path) -> None:
    scene = scene_in(tmp_path)
    held_out = frozenset({"day one/1.png", "day one/4.png"})
    folder = unpacked(scene, tmp_path, held_out)
    document = json.loads((folder / "transforms.json").read_text())
    assert document["test_filenames"] == ["images/day one/1.png", "images/day one/4.png"]
    assert len(document["train_filenames"]) == 3
    for file in (folder / "sparse/0").iterdir():
        file.unlink()
    poses = posed.find(tmp_path)
    assert poses is not None
    assert poses.source == "transforms"
    read = poses.load()
    assert_same(read, scene)
    assert {view.name for view in read.views if view.split == "test"} == held_out


def test_refined_cameras_and_the_offset_are_those_of_the_model(tmp_path: Path) -> None:
    scene = scene_in(tmp_path, (None, None, None))
    far = np.array([450_000.0, -7_000.0, 12.0])
    moved = replace(
        scene,
        points=scene.points + far,
        views=tuple(replace(v, camera=v.camera.moved_to(v.camera.center + far)) for v in scene.views),
    )
    refined = {scene.views[1].name: viewmat_of(scene.views[0].camera.viewmat[:3, :3], np.ones(3))}
    write_cameras(tmp_path / "cameras.zip", moved, refined, far, frozenset())
    with zipfile.ZipFile(tmp_path / "cameras.zip") as archive:
        archive.extractall(tmp_path / "poses")
    poses = posed.find(tmp_path)
    assert poses is not None
    read = poses.load()
    np.testing.assert_allclose(read.views[1].camera.viewmat, refined[scene.views[1].name], atol=1e-12)
    np.testing.assert_allclose(read.views[2].camera.center, scene.views[2].camera.center, atol=1e-9)
    np.testing.assert_allclose(sorted(read.points[:, 0]), sorted(scene.points[:, 0]), atol=1e-9)
    assert (
        pycolmap.Reconstruction(tmp_path / "poses/sparse/0").num_cameras() == 1
    )  # one camera took all three


def test_a_lens_without_a_counterpart_leaves_transforms_json_out(tmp_path: Path) -> None:
    lens = Lens("FOV", (60.0, 61.0, 31.0, 25.0, 0.5), 64, 48)
    folder = unpacked(scene_in(tmp_path, (None, lens)), tmp_path)
    assert [path.name for path in folder.iterdir()] == ["sparse"]


def test_a_scene_without_points_is_a_model_too(tmp_path: Path) -> None:
    scene = replace(
        scene_in(tmp_path, (None, None)),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_errors=None,
        track_lengths=None,
        point_views=None,
    )
    unpacked(scene, tmp_path)
    poses = posed.find(tmp_path)
    assert poses is not None
    assert_same(poses.load(), scene)

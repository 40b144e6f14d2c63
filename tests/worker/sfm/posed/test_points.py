"""Proves where the points of posed captures come from: given ones that photos confirm, or triangulation.

Proven on generated photos, whose cameras and depths are known exactly, in every format of poses. Does not prove that
training gains from such points, which `bench train` measures (fox-no-points and others).
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker import synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.scene import Camera, Float, Lens, Scene, Source, View, viewmat_of
from splatmill_worker.sfm import posed, stereo
from splatmill_worker.sfm.matching.overlap import by_overlap
from splatmill_worker.sfm.options import LEAN
from splatmill_worker.sfm.posed.judged import points
from splatmill_worker.sfm.posed.judged.searched import model_of
from splatmill_worker.sfm.posed.judged.triangulation import Triangulated, triangulate
from splatmill_worker.splat.plan.decide import decide
from tests.support.plans.facts import FACTS
from tests.support.posed_sets import FLIP, document

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, COUNT = 320, 240, 14

FEWER = 8
"""Photos of a little more than half of the orbit, which are enough to know whether there are points, and whether the
cameras are right."""

Truth = dict[str, Camera]

Shown = Callable[[Camera], tuple[np.ndarray, np.ndarray]]
"""The colours and true depths that a camera sees."""


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A folder of photos, and their true cameras by name."""
    folder = tmp_path_factory.mktemp("posed") / "images"
    folder.mkdir()
    return folder, synthetic.capture(folder, COUNT, WIDTH, HEIGHT, samples=1)


@pytest.fixture(scope="module")
def bare(photos: tuple[Path, Truth]) -> Scene:
    """The photos with their true cameras and no points."""
    folder, truth = photos
    views = tuple(View(name, camera, folder / name) for name, camera in sorted(truth.items()))
    return Scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "transforms")


@pytest.fixture(scope="module")
def triangulation(bare: Scene) -> Triangulated:
    return triangulate(bare.views, LEAN)


@pytest.fixture(scope="module")
def shown() -> Shown:
    """What a camera sees, which is computed once for all tests."""
    pictures: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def see(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        place = camera.viewmat.tobytes()
        if place not in pictures:
            pictures[place] = synthetic.photograph(synthetic.still_life(), camera, samples=1)
        return pictures[place]

    return see


def depth_errors(scene: Scene, points: np.ndarray, shown_by: np.ndarray, shown: Shown) -> np.ndarray:
    """Relative depth error of each point in the view that shows it; the nearest true depth of 3 x 3 pixels."""
    errors = []
    for index in np.unique(shown_by):
        camera = scene.views[index].camera
        projection = camera.project(points[shown_by == index])
        _, depth = shown(camera)
        rows = np.clip(projection.rows.astype(int)[:, None] + np.repeat([-1, 0, 1], 3), 0, HEIGHT - 1)
        columns = np.clip(projection.columns.astype(int)[:, None] + np.tile([-1, 0, 1], 3), 0, WIDTH - 1)
        errors.append(np.abs(depth[rows, columns] / projection.depths[:, None] - 1.0).min(axis=1))
    return np.concatenate(errors)


def test_triangulated_points_lie_on_the_surfaces(
    bare: Scene, triangulation: Triangulated, shown: Shown
) -> None:
    assert len(triangulation.points) > 200
    first = np.array([track[0] for track in triangulation.tracks])
    errors = depth_errors(bare, triangulation.points, first, shown)
    assert np.median(errors) < 0.005
    assert np.mean(errors < 0.03) > 0.9
    assert triangulation.agreeing > 0.9 * triangulation.matches
    assert triangulation.disagreement < 0.5
    assert min(map(len, triangulation.tracks)) >= 3


def test_colours_are_those_of_the_photos(bare: Scene, triangulation: Triangulated) -> None:
    most = np.bincount([index for track in triangulation.tracks for index in track]).argmax()
    own = [row for row, track in enumerate(triangulation.tracks) if most in track]
    projection = bare.views[most].camera.project(triangulation.points[own])
    photo = np.asarray(Image.open(bare.views[most].image)).astype(float)
    there = photo[projection.rows.astype(int), projection.columns.astype(int)]
    assert np.median(np.abs(there - triangulation.colors[own])) < 15


def transforms(truth: Truth, names: list[str]) -> str:
    return json.dumps(document({name: truth[name] for name in sorted(names)}))


def colmap_model(truth: Truth) -> pycolmap.Reconstruction:
    names = sorted(truth)
    model = model_of([truth[name] for name in names])
    for number, name in enumerate(names, 1):
        model.images[number].name = name
    return model


def colmap_text(poses: Path, truth: Truth) -> None:
    colmap_model(truth).write_text(poses)
    (poses / "points3D.txt").write_text("")


def colmap_binary(poses: Path, truth: Truth) -> None:
    colmap_model(truth).write_binary(poses)
    (poses / "points3D.bin").unlink()


def nerfstudio(poses: Path, truth: Truth) -> None:
    (poses / "transforms.json").write_text(transforms(truth, list(truth)))


def blender(poses: Path, truth: Truth) -> None:
    tests = sorted(truth)[::8]
    (poses / "transforms_train.json").write_text(transforms(truth, sorted(set(truth) - set(tests))))
    (poses / "transforms_test.json").write_text(transforms(truth, tests))


@pytest.mark.parametrize("write", [colmap_text, colmap_binary, nerfstudio, blender])
def test_captures_of_every_format_get_points_and_keep_their_cameras(
    photos: tuple[Path, Truth], tmp_path: Path, write: Callable[[Path, Truth], None]
) -> None:
    folder, everything = photos
    truth = {name: everything[name] for name in sorted(everything)[:FEWER]}
    for part in ("poses", "images"):
        (tmp_path / "capture" / part).mkdir(parents=True)
    for name in truth:
        (tmp_path / "capture" / "images" / name).symlink_to(folder / name)
    write(tmp_path / "capture" / "poses", truth)
    stages: list[str] = []
    scene = posed_scene(
        tmp_path / "capture", tmp_path / "work", TrainOptions(), lambda stage, *_: stages.append(stage), bool
    )
    assert scene.facts["triangulated_points"] > 50
    assert len(scene.points) >= scene.facts["triangulated_points"]
    assert scene.point_views is not None
    assert {"features", "matching", "triangulation", "stereo"} == set(stages)
    assert set(scene.facts["seconds"]) == {"features", "matching", "triangulation"}
    assert "no_points" not in scene.facts
    for view in scene.views:
        np.testing.assert_allclose(view.camera.viewmat, truth[view.name].viewmat, atol=1e-9)
    held_out = {index for index, view in enumerate(scene.views) if view.split == "test"}
    assert not held_out & set(scene.point_views.views.tolist())
    stages.clear()
    again = posed_scene(
        tmp_path / "capture", tmp_path / "work", TrainOptions(), lambda stage, *_: stages.append(stage), bool
    )
    assert stages == []
    np.testing.assert_array_equal(again.points, scene.points)
    assert again.point_views is not None
    np.testing.assert_array_equal(again.point_views.views, scene.point_views.views)


def surface_points(bare: Scene, count: int, shown: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Points on the true surfaces with the photos' colours."""
    random, points, colors = np.random.default_rng(0), [], []
    for view in bare.views[::4]:
        color, depth = shown(view.camera)
        rows, columns = random.integers(HEIGHT, size=count // 4), random.integers(WIDTH, size=count // 4)
        points.append(view.camera.unproject(columns + 0.5, rows + 0.5, depth[rows, columns]))
        colors.append(color[rows, columns])
    return np.concatenate(points), np.concatenate(colors)


def test_points_without_tracks_are_used_where_photos_show_their_colours(
    bare: Scene, shown: Shown, tmp_path: Path
) -> None:
    points, colors = surface_points(bare, 8000, shown)  # enough for stereo to be left out
    wrong = colors.copy()
    wrong[:400] = (255, 0, 255)  # nothing in the still life has this colour
    scene = posed.with_points(replace(bare, points=points, colors=wrong), tmp_path)
    assert scene.facts["loose_points"] == 8000
    used = scene.facts["loose_points_used"]
    assert 7500 < used <= 7600
    assert {tuple(point) for point in scene.points} <= {tuple(point) for point in points[400:]}
    assert len(scene.points) == used
    assert not (scene.colors == (255, 0, 255)).all(axis=1).any()
    assert f"8000 points came without tracks. {used} of them are used" in " ".join(scene.notes)
    assert "triangulated_points" not in scene.facts


def test_points_of_another_frame_are_left_out_with_the_numbers(
    bare: Scene, shown: Shown, tmp_path: Path
) -> None:
    points, colors = surface_points(bare, 2000, shown)
    turned = points[:, [1, 2, 0]]
    five = replace(bare, views=bare.views[:5])
    scene = posed.with_points(replace(five, points=turned, colors=colors), tmp_path)
    assert scene.facts["loose_points_used"] == 0
    assert "triangulated_points" in scene.facts
    assert "The 2000 points that came without tracks are not used" in scene.notes[0]


def test_points_without_colours_get_those_of_the_photos(bare: Scene, shown: Shown, tmp_path: Path) -> None:
    points, colors = surface_points(bare, 8000, shown)
    scene = posed.with_points(replace(bare, points=points, colors=np.zeros_like(colors)), tmp_path)
    used = scene.facts["loose_points_used"]
    assert used > 7600
    assert np.median(np.abs(scene.colors[:used].astype(float) - colors[:used])) < 40


def test_a_colmap_model_keeps_points_that_have_no_track(photos: tuple[Path, Truth], tmp_path: Path) -> None:
    folder, truth = photos
    (tmp_path / "poses").mkdir()
    (tmp_path / "images").symlink_to(folder)
    model = colmap_model(truth)
    for xyz in np.random.default_rng(0).normal(0.0, 0.3, (50, 3)):
        model.add_point3D(xyz, pycolmap.Track(), np.array([10, 20, 30], np.uint8))
    model.write_text(tmp_path / "poses")
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert len(scene.points) == 50
    assert scene.point_views is None


def moved(view: View, index: int) -> View:
    """The view with the rotation of a camera that looks elsewhere."""
    angle = np.radians(25.0 * (1 + index % 5))
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    camera = view.camera
    return replace(
        view, camera=replace(camera, viewmat=viewmat_of(turn @ camera.viewmat[:3, :3], camera.center))
    )


def test_wrong_cameras_are_named_and_the_random_start_says_why(bare: Scene, tmp_path: Path) -> None:
    wrong = replace(bare, views=tuple(moved(view, index) for index, view in enumerate(bare.views[:FEWER])))
    scene = posed.with_points(wrong, tmp_path)
    assert scene.facts["matches_explained_by_cameras"] < 0.3
    assert "The poses or the intrinsics are wrong" in scene.warnings[0]
    if len(scene.points) < 20:
        plan = decide(
            replace(FACTS, points=len(scene.points), no_points=scene.facts["no_points"]),
            TrainOptions(),
            "cpu",
        )
        assert plan.initial == "random"
        assert plan.reasons["initial"].startswith("The given cameras explain only")


@pytest.mark.parametrize(("enough", "shift"), [(False, 5), (True, 5), (True, 2)])
def test_points_with_tracks_are_checked_in_the_photos_that_the_tracks_name(
    enough: bool, shift: int, bare: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few points bring a search for more, which shows it as well."""
    scene = posed.with_points(replace(bare, views=bare.views[:10]), tmp_path)
    assert scene.point_views is not None
    monkeypatch.setattr(points, "_lacks_points", lambda _: not enough)
    assert posed.with_points(scene, tmp_path / "right").warnings == ()
    files = [view.image for view in scene.views]
    exchanged = tuple(
        replace(view, image=files[(index + shift) % len(files)]) for index, view in enumerate(scene.views)
    )
    wrong = posed.with_points(replace(scene, views=exchanged), tmp_path / "wrong")
    [warning] = wrong.warnings
    assert warning.startswith("The given cameras explain only")
    assert "belong to other photos" in warning
    assert len(wrong.points) >= len(scene.points)


def test_cameras_that_are_all_in_one_place_explain_only_what_their_turn_does(bare: Scene) -> None:
    def at(view: View, turn: np.ndarray, center: np.ndarray) -> View:
        return replace(view, camera=replace(view.camera, viewmat=viewmat_of(turn, center)))

    place = bare.views[0].camera.center
    views = [at(view, view.camera.viewmat[:3, :3], place) for view in bare.views[:5]]
    result = triangulate(views, LEAN)
    assert result.matches > 0
    assert result.agreeing < 0.5 * result.matches


@pytest.mark.parametrize(
    ("source", "named", "misread"),
    [
        ("transforms", "from camera to world with OpenCV axes", lambda true: FLIP @ true),
        (
            "transforms",
            "from world to camera with OpenGL axes",
            lambda true: FLIP @ np.linalg.inv(true) @ FLIP,
        ),
        ("transforms", "from world to camera with OpenCV axes", lambda true: FLIP @ np.linalg.inv(true)),
        ("colmap", "from camera to world with OpenCV axes", np.linalg.inv),
        ("transforms", "", lambda true: true[[1, 2, 0, 3]]),
    ],
)
def test_another_convention_of_matrices_is_suggested(
    bare: Scene, source: Source, named: str, misread: Callable[[Float], Float]
) -> None:
    views = [
        replace(view, camera=replace(view.camera, viewmat=misread(view.camera.viewmat)))
        for view in bare.views[:5]
    ]
    result = triangulate(views, LEAN, source=source)
    assert result.agreeing < 0.5 * result.matches
    assert result.convention == named
    assert (result.convention_share > 0.8) == bool(named)


def test_a_wrong_focal_length_is_named(bare: Scene, tmp_path: Path) -> None:
    views = tuple(
        replace(view, camera=replace(view.camera, fx=2.0 * view.camera.fx, fy=2.0 * view.camera.fy))
        for view in bare.views[:FEWER]
    )
    scene = posed.with_points(replace(bare, views=views), tmp_path)
    assert scene.warnings
    assert scene.facts["matches_explained_by_cameras"] < 0.5


def test_small_errors_of_the_cameras_are_measured(
    bare: Scene, triangulation: Triangulated, tmp_path: Path
) -> None:
    random = np.random.default_rng(0)
    views = []
    for view in bare.views:
        rotation = view.camera.viewmat[:3, :3]
        center = view.camera.center + random.normal(0.0, 0.005, 3)
        views.append(replace(view, camera=replace(view.camera, viewmat=viewmat_of(rotation, center))))
    scene = posed.with_points(replace(bare, views=tuple(views)), tmp_path)
    assert scene.facts["triangulated_points"] > 150
    assert scene.facts["match_error_px"] > 1.5 * triangulation.disagreement


def test_two_photos_give_points(bare: Scene, tmp_path: Path) -> None:
    first = bare.views[0]
    rotation = first.camera.viewmat[:3, :3]
    beside = replace(first.camera, viewmat=viewmat_of(rotation, first.camera.center + 0.4 * rotation[0]))
    photo, _ = synthetic.photograph(synthetic.still_life(), beside, samples=1)
    Image.fromarray(photo).save(tmp_path / "beside.png")
    two = triangulate([first, View("beside.png", beside, tmp_path / "beside.png")], LEAN)
    assert len(two.points) > 20
    assert {len(track) for track in two.tracks} == {2}


def test_photos_without_features_fall_back_with_the_reason(bare: Scene, tmp_path: Path) -> None:
    Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(tmp_path / "plain.png")
    plain = replace(bare, views=tuple(replace(view, image=tmp_path / "plain.png") for view in bare.views))
    scene = posed.with_points(plain, tmp_path / "work")
    assert len(scene.points) == 0
    assert scene.facts["no_points"] == "Half of the photos have at most 0 features, too few to be matched."
    plan = decide(replace(FACTS, points=0, no_points=scene.facts["no_points"]), TrainOptions(), "cpu")
    assert plan.initial == "random"
    assert plan.reasons["initial"].startswith(scene.facts["no_points"])


def cut_out(scene: Scene, shown: Shown, folder: Path) -> Scene:
    """The scene with photos that are transparent beside the middle of the still life."""
    views = []
    for view in scene.views:
        color, depth = shown(view.camera)
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        places = view.camera.unproject(columns.ravel(), rows.ravel(), depth.ravel()).reshape(*depth.shape, 3)
        alpha = np.where(np.hypot(places[..., 0], places[..., 1]) < 1.5, 255, 0).astype(np.uint8)
        photo = (folder / view.name).with_suffix(".png")
        Image.fromarray(np.dstack([color, alpha])).save(photo)
        views.append(replace(view, image=photo))
    return replace(scene, views=tuple(views))


def share_outside(scene: Scene, points: np.ndarray) -> float:
    """Share of the places, over all photos, where a point falls on transparent pixels and has none else around it."""
    outside = total = 0
    for view in scene.views:
        projection = view.camera.project(points)
        alpha = np.asarray(Image.open(view.image))[:, :, 3]
        near = np.max([np.roll(alpha, (a, b), (0, 1)) for a in (-1, 0, 1) for b in (-1, 0, 1)], axis=0)
        rows, columns = (
            projection.rows[projection.inside].astype(int),
            projection.columns[projection.inside].astype(int),
        )
        outside += int((near[rows, columns] == 0).sum())
        total += len(rows)
    return outside / total


def test_cut_outs_get_points_inside_their_outlines(bare: Scene, shown: Shown, tmp_path: Path) -> None:
    cut = cut_out(bare, shown, tmp_path)
    scene = posed.with_points(cut, tmp_path / "work")
    assert "no_points" not in scene.facts
    assert scene.facts["stereo_points"] == len(scene.points) > 300
    assert "triangulated_points" not in scene.facts
    assert scene.point_views is not None
    first = scene.point_views.views[scene.point_views.offsets[:-1]]
    errors = depth_errors(scene, scene.points, first, shown)
    assert np.median(errors) < 0.01
    assert np.mean(errors < 0.03) > 0.9
    assert share_outside(cut, scene.points) == 0.0


def test_one_wrong_outline_does_not_remove_the_points_of_the_others(
    bare: Scene, shown: Shown, tmp_path: Path
) -> None:
    cut = cut_out(bare, shown, tmp_path)
    views = cut.views * 2
    color = np.asarray(Image.open(views[0].image))[:, :, :3]
    Image.fromarray(np.dstack([color, np.zeros((HEIGHT, WIDTH), np.uint8)])).save(tmp_path / "empty.png")
    views = (replace(views[0], image=tmp_path / "empty.png"), *views[1:])
    views = tuple(replace(view, name=f"{number:02d}") for number, view in enumerate(views))
    assert len(stereo.find_points(replace(cut, views=views)).points) > 200


def test_given_points_outside_the_outlines_of_transparent_photos_are_left_out(
    bare: Scene, shown: Shown, tmp_path: Path
) -> None:
    cut = cut_out(bare, shown, tmp_path)
    points, colors = surface_points(bare, 8000, shown)
    scene = posed.with_points(replace(cut, points=points, colors=colors), tmp_path / "work")
    assert 100 < scene.facts["loose_points_used"] < 8000
    assert "lie where a photo is transparent" in scene.notes[0]
    assert share_outside(cut, scene.points) == 0.0


def test_other_lenses_points_and_masks_are_stored_apart(bare: Scene, tmp_path: Path) -> None:
    few = replace(bare, views=bare.views[:3])
    lens = Lens("OPENCV", (250.0, 250.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0), WIDTH, HEIGHT)
    Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(tmp_path / "white.png")
    scenes = [
        few,
        replace(few, views=tuple(replace(view, lens=lens) for view in few.views)),
        replace(few, views=tuple(replace(view, mask=tmp_path / "white.png") for view in few.views)),
        few,
    ]
    for done, scene in enumerate(scenes):
        posed.with_points(scene, tmp_path / "work")
        stored = list((tmp_path / "work" / "sfm").glob("triangulated-*"))
        assert len(stored) == min(done + 1, 3)


def test_cameras_of_an_orbit_overlap_with_their_neighbours(bare: Scene) -> None:
    cameras = [view.camera for view in bare.views]
    chosen = by_overlap(cameras, 4)
    centers = bare.centers
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    typical = np.median(apart[~np.eye(len(cameras), dtype=bool)])
    assert all(any(index in pair for pair in chosen) for index in range(len(cameras)))
    assert np.mean([apart[pair] for pair in chosen]) < 0.8 * typical
    assert by_overlap([cameras[0]] * 3, 4) == set()  # a tripod: nothing can be triangulated

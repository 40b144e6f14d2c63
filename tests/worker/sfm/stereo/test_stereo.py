"""Proves that stereo points lie on the scene's surfaces, fill places without points, and when none are searched for.

Proven on generated photos, whose cameras and depths are known exactly. Does not prove that training gains from such
points on real photos, which the benchmarks measure.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.load import load_views
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm import stereo
from splatmill_worker.sfm.stereo.plane_sweep import GreyView, sweep

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Photos with their true cameras and no points."""
    folder = tmp_path_factory.mktemp("stereo")
    truth = synthetic.capture(folder, 18, WIDTH, HEIGHT, samples=1)
    views = tuple(View(name, camera, folder / name) for name, camera in sorted(truth.items()))
    return Scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "transforms")


@pytest.fixture(scope="module")
def added(bare: Scene) -> stereo.StereoPoints:
    return stereo.find_points(bare)


@pytest.fixture(scope="module")
def depths(bare: Scene) -> list[np.ndarray]:
    """The true depth [HEIGHT, WIDTH] of each view."""
    still = synthetic.still_life()
    return [synthetic.photograph(still, view.camera, samples=1)[1] for view in bare.views]


def shows(cloud: stereo.StereoPoints, views: int) -> np.ndarray:
    """Which of so many views show each point, bool [n,views]."""
    table = np.zeros((len(cloud.points), views), bool)
    table[np.repeat(np.arange(len(table)), np.diff(cloud.offsets)), cloud.views] = True
    return table


def depth_errors(scene: Scene, cloud: stereo.StereoPoints, depths: list[np.ndarray]) -> np.ndarray:
    """Relative depth error of each point in the first view that saw it; the nearest true depth of 3 x 3 pixels."""
    errors = []
    visible = shows(cloud, len(scene.views))
    for index, view in enumerate(scene.views):
        own = visible[:, index] & ~visible[:, :index].any(axis=1)
        x, y, z, _ = view.camera.project(cloud.points[own])
        depth = depths[index]
        rows = np.clip(y.astype(int)[:, None] + np.repeat([-1, 0, 1], 3), 0, HEIGHT - 1)
        columns = np.clip(x.astype(int)[:, None] + np.tile([-1, 0, 1], 3), 0, WIDTH - 1)
        errors.append(np.abs(depth[rows, columns] / z[:, None] - 1.0).min(axis=1))
    return np.concatenate(errors)


def test_points_are_found_on_the_surfaces_without_any_to_begin_with(
    bare: Scene, added: stereo.StereoPoints, depths: list[np.ndarray]
) -> None:
    assert not added.given_up
    assert len(added.points) > 500
    errors = depth_errors(bare, added, depths)
    # A pixel between views 9 degrees apart is 1/300/tan(9) = 2 per cent of the depth; half of that is usual.
    assert np.median(errors) < 0.01
    assert np.mean(errors < 0.03) > 0.9
    assert np.diff(added.offsets).min() >= 3  # the photo itself and two that agree
    assert added.errors.min() >= 0.0
    assert added.errors.max() <= 1.0


def test_colours_are_those_of_the_photos(bare: Scene, added: stereo.StereoPoints) -> None:
    camera = bare.views[0].camera
    own = np.flatnonzero(shows(added, len(bare.views))[:, 0])
    x, y, _, inside = camera.project(added.points[own])
    photo = np.asarray(Image.open(bare.views[0].image)).astype(float)
    there = photo[y[inside].astype(int), x[inside].astype(int)]
    assert np.median(np.abs(there - added.colors[own][inside])) < 12


def test_known_points_stay_and_empty_places_are_filled(bare: Scene, added: stereo.StereoPoints) -> None:
    visible = shows(added, len(bare.views))[::3]
    few = replace(
        added,
        points=added.points[::3],
        colors=added.colors[::3],
        errors=added.errors[::3],
        views=np.nonzero(visible)[1].astype(np.int32),
        offsets=np.concatenate([[0], np.cumsum(visible.sum(axis=1))]),
    )
    first = stereo.add(bare, few)
    more = stereo.find_points(first)
    assert 200 < len(more.points) < len(added.points)
    both = stereo.add(first, more)
    np.testing.assert_array_equal(both.points[: len(few.points)], few.points)
    assert both.point_views is not None
    assert both.point_views.offsets[-1] == len(both.point_views.views)
    np.testing.assert_array_equal(np.diff(both.point_views.offsets), both.track_lengths)
    assert both.facts["sparse_points"] == len(few.points)
    assert both.facts["stereo_points"] == len(more.points)
    assert str(len(more.points)) in both.notes[-1]


def test_masked_places_get_no_points(bare: Scene, tmp_path: Path) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    views = [replace(view, mask=tmp_path / "mask.png") for view in bare.views[:3]]
    grey = [GreyView.of(photo) for photo in load_views(views, WIDTH)]
    outcome = sweep(grey[1], [grey[0], grey[2]], grey[1].camera.project(bare.points), 1.5, 12.0)
    assert outcome.tried > 50
    assert len(outcome.points) > 20
    assert grey[1].camera.project(outcome.points).columns.min() >= WIDTH // 2


def of_noise(scene: Scene, count: int, folder: Path) -> Scene:
    """The first `count` cameras of the scene, each with a photo of blobs that no other photo shows."""
    random, views = np.random.default_rng(0), []
    for view in scene.views[:count]:
        noise = random.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8)
        Image.fromarray(noise).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC).save(folder / view.name)
        views.append(replace(view, image=folder / view.name))
    return replace(scene, views=tuple(views))


def test_the_search_is_given_up_for_photos_without_a_common_scene(bare: Scene, tmp_path: Path) -> None:
    cloud = stereo.find_points(of_noise(bare, len(bare.views), tmp_path))
    assert cloud.given_up
    assert len(cloud.points) == 0
    assert stereo.add(bare, cloud).facts["stereo_points"] == 0


def test_scenes_with_enough_points_get_none(bare: Scene, tmp_path: Path) -> None:
    middle = np.random.default_rng(0).normal(0.0, 0.2, (2000, 3))
    full = replace(bare, points=middle, colors=np.zeros((2000, 3), np.uint8))
    assert stereo.observations_per_view(full) > 1900
    assert stereo.with_stereo_points(full, tmp_path / "stereo.npz") is full


def test_a_search_can_be_cancelled(bare: Scene) -> None:
    with pytest.raises(Cancelled):
        stereo.find_points(bare, cancelled=lambda: True)


def test_loading_photos_can_be_cancelled(bare: Scene, tmp_path: Path) -> None:
    asked = iter([False, False, True])
    gone = [replace(view, image=tmp_path / "gone.png") for view in bare.views[6:]]
    with pytest.raises(Cancelled):  # and not OSError: the photos that are gone are not waited for
        stereo.find_points(replace(bare, views=(*bare.views[:6], *gone)), cancelled=lambda: next(asked))


def test_the_search_is_given_up_for_three_photos_too(bare: Scene, tmp_path: Path) -> None:
    cloud = stereo.find_points(of_noise(bare, 3, tmp_path))
    assert cloud.given_up
    assert len(cloud.points) == 0


def test_photos_held_out_by_the_data_set_take_no_part(
    bare: Scene, tmp_path: Path, depths: list[np.ndarray]
) -> None:
    tests = (0, 9)
    views = tuple(
        replace(view, split="test", image=tmp_path / "gone.png")
        if i in tests
        else replace(view, split="train")
        for i, view in enumerate(bare.views)
    )
    calls: list[tuple[str, int, int]] = []
    cloud = stereo.find_points(replace(bare, views=views), lambda *call: calls.append(call[:3]))
    count = len(views) - len(tests)
    numbers = [*range(1, count + 1), *range(count)]  # loaded, and then searched
    assert calls == [("stereo", number, count) for number in numbers]
    assert len(cloud.points) > 300
    visible = shows(cloud, len(views))
    assert not visible[:, tests].any()
    assert visible[:, 1].any()
    assert np.median(depth_errors(bare, cloud, depths)) < 0.01


def test_without_tracks_of_its_own_points_a_scene_gets_none(bare: Scene, added: stereo.StereoPoints) -> None:
    own = np.random.default_rng(0).normal(0.0, 0.2, (30, 3))
    both = stereo.add(replace(bare, points=own, colors=np.zeros((30, 3), np.uint8)), added)
    assert len(both.points) == 30 + len(added.points)
    assert both.point_views is None
    assert both.track_lengths is None
    assert both.point_errors is not None
    assert np.isnan(both.point_errors[:30]).all()
    np.testing.assert_array_equal(both.point_errors[30:], added.errors)


def test_the_note_says_when_cameras_came_without_points(bare: Scene, added: stereo.StereoPoints) -> None:
    assert "without points" in stereo.add(bare, added).notes[-1]

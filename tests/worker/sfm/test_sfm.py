"""Proves the way from photos to cameras on real and on generated photos: poses against the truth, named failures,
caching, cancelling, and the parts that choose and match pairs.

Not proven here: speed and quality on larger sets, which `bench sfm` measures.
"""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker import sfm, synthetic
from splatmill_worker.errors import Cancelled
from splatmill_worker.images import exif
from splatmill_worker.images.prepare import UsablePhoto
from splatmill_worker.scene import Camera, Scene
from splatmill_worker.sfm import cameras
from splatmill_worker.sfm.features import Features
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.matching.matcher import MAX_ANGLE, MAX_RATIO, Matcher
from tests.support.paths import DATA

pytestmark = pytest.mark.slow

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data folder is not beside the project")


def quiet(stage: str, done: int, total: int, note: str) -> None:
    pass


def reconstruct(images: Path, workdir: Path, **options: object) -> Scene:
    return sfm.reconstruct(images, None, workdir, sfm.SfmOptions(**options), quiet, lambda: False)  # type: ignore[arg-type]


def errors(scene: Scene, truth: dict[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation errors in degrees and position errors over the cameras' spread, after the best similarity (Umeyama)."""
    ours = np.array([view.camera.center for view in scene.views])
    theirs = np.array([truth[view.name].center for view in scene.views])
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    moved = scale * a @ turn.T
    rotations = []
    for view in scene.views:
        delta = view.camera.viewmat[:3, :3] @ turn.T @ truth[view.name].viewmat[:3, :3].T
        rotations.append(math.degrees(math.acos(np.clip((np.trace(delta) - 1.0) / 2.0, -1.0, 1.0))))
    return np.array(rotations), np.linalg.norm(moved - b, axis=1) / np.linalg.norm(b, axis=1).max()


@pytest.fixture(scope="module")
def still_life(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    folder = tmp_path_factory.mktemp("still") / "images"
    return folder, synthetic.capture(folder, 16, 480, 360)


@pytest.fixture(scope="module")
def solved(
    still_life: tuple[Path, dict[str, Camera]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Scene, Path]:
    workdir = tmp_path_factory.mktemp("work")
    return reconstruct(still_life[0], workdir), workdir


def test_cameras_of_generated_photos_match_the_truth(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    scene, _ = solved
    assert len(scene.views) == 16
    rotations, positions = errors(scene, still_life[1])
    assert np.median(rotations) < 0.3
    assert np.median(positions) < 0.01
    true = next(iter(still_life[1].values()))
    assert scene.views[0].camera.fx == pytest.approx(true.fx, rel=0.03)
    assert scene.facts["registered"] == 16
    assert scene.colors.std() > 10  # painted from the photos, not left black
    assert scene.point_views is not None
    assert scene.point_views.views.max() < 16
    assert scene.facts["stereo_points"] > 0
    assert scene.facts["seconds"]["stereo"] >= 0.9 * scene.facts["stereo_seconds"]


def test_a_restart_reads_the_cameras_back(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    first, workdir = solved
    stages: list[str] = []
    again = sfm.reconstruct(
        still_life[0], None, workdir, sfm.SfmOptions(), lambda stage, *_: stages.append(stage), lambda: False
    )
    assert set(stages) == {"images"}
    np.testing.assert_array_equal(again.points, first.points)
    for a, b in zip(again.views, first.views, strict=True):
        np.testing.assert_array_equal(a.camera.viewmat, b.camera.viewmat)


def test_cancelling_ends_it_and_a_restart_goes_on(
    still_life: tuple[Path, dict[str, Camera]], tmp_path: Path
) -> None:
    seen: list[str] = []

    def watch(stage: str, done: int, total: int, note: str) -> None:
        seen.append(stage)

    lean = sfm.SfmOptions(effort="lean")  # a raised effort would look for features again
    with pytest.raises(Cancelled):
        sfm.reconstruct(still_life[0], None, tmp_path, lean, watch, lambda: "matching" in seen)
    assert "mapping" not in seen
    before = len(seen)
    scene = sfm.reconstruct(still_life[0], None, tmp_path, lean, watch, lambda: False)
    assert "features" not in seen[before:]
    assert len(scene.views) >= 14


def test_the_global_mapper_can_be_asked_for(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    scene = reconstruct(still_life[0], solved[1], mapper="global")
    assert scene.facts["mapper"] == "global"
    assert len(scene.views) >= 14
    assert np.median(errors(scene, still_life[1])[0]) < 0.5


def test_too_few_photos_are_refused(tmp_path: Path) -> None:
    empty = tmp_path / "images"
    empty.mkdir()
    with pytest.raises(sfm.SfmFailed) as none:
        reconstruct(empty, tmp_path / "a")
    assert none.value.code == "no_images"
    synthetic.capture(empty, 2, 64, 48)
    with pytest.raises(sfm.SfmFailed) as two:
        reconstruct(empty, tmp_path / "b")
    assert two.value.code == "too_few_images"
    assert two.value.facts["photos"] == 2


@needs_data
def test_kermit_finds_all_its_cameras(tmp_path: Path) -> None:
    scene = reconstruct(DATA / "kermit_640x480/images", tmp_path)
    assert len(scene.views) == 11
    assert scene.facts["reprojection_pixels"] < 1.0
    assert scene.left_out == ()


@needs_data
@pytest.mark.parametrize(
    ("folder", "code"),
    [("failure_unrelated_640", "sfm_too_few_registered"), ("failure_pure_rotation", "sfm_no_parallax")],
)
def test_hopeless_photos_end_by_name(tmp_path: Path, folder: str, code: str) -> None:
    with pytest.raises(sfm.SfmFailed) as failed:
        reconstruct(DATA / folder / "images", tmp_path)
    assert failed.value.code == code
    assert failed.value.facts["photos"] == len(list((DATA / folder / "images").iterdir()))
    assert failed.value.advice


def random_features(count: int, seed: int) -> Features:
    random = np.random.default_rng(seed)
    descriptors = random.integers(0, 256, (count, 128), np.uint8)
    return Features(
        random.uniform(0, 500, (count, 2)), random.uniform(1, 9, count).astype(np.float32), descriptors
    )


def test_matches_are_the_mutual_nearest_that_pass_the_ratio_test() -> None:
    a, b = random_features(300, 1), random_features(700, 2)
    noise = np.random.default_rng(3).integers(-12, 13, (200, 128))
    b.descriptors[100:300] = np.clip(a.descriptors[:200].astype(int) + noise, 0, 255)
    b.descriptors[300:310] = b.descriptors[100:110]  # ten ambiguous ones
    found = {tuple(row) for row in Matcher([a, b]).match(0, 1).tolist()}
    unit = [
        f.descriptors / np.linalg.norm(f.descriptors.astype(float), axis=1, keepdims=True) for f in (a, b)
    ]
    angles = np.arccos(np.clip(unit[0] @ unit[1].T, -1, 1))
    expected = set()
    for row in range(300):
        first, second = np.argsort(angles[row])[:2]
        if angles[:, first].argmin() == row and angles[row, first] < min(
            MAX_ANGLE, MAX_RATIO * angles[row, second]
        ):
            expected.add((row, int(first)))
    assert found == expected
    assert found == {(k, 100 + k) for k in range(10, 200)}


def usable(name: str, **tags: object) -> UsablePhoto:
    return UsablePhoto(name, Path(name), name, 640, 480, exif.Exif(**tags))  # type: ignore[arg-type]


def test_photos_that_agree_share_a_camera() -> None:
    phone = {"make": "A", "model": "B", "focal_in_diagonals": 0.6}
    groups = cameras.group([usable("1", **phone), usable("2"), usable("3", **phone), usable("4")])
    assert [group.photos for group in groups] == [(0, 2), (1, 3)]
    assert groups[0].known
    assert groups[0].focal == pytest.approx(0.6 * 800 / 640)
    assert not groups[1].known


def test_gps_neighbours_are_the_nearest_ones() -> None:
    # A walk along a meridian, 11 metres a step, across the date line's other side for good measure.
    photos = [usable(str(k), latitude=10.0 + 1e-4 * k, longitude=180.0 - 1e-9) for k in range(6)]
    photos.append(usable("nowhere"))
    places = pairs.gps_positions(photos)
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(11.1, rel=0.01)
    assert np.isnan(places[6, :2]).all()
    two = pairs.spatial(places, 2)
    assert {(k, k + 1) for k in range(5)} <= two
    # Only the ends reach further than their neighbours.
    assert two - {(k, k + 1) for k in range(5)} == {(0, 2), (3, 5)}
    assert all(index != 6 for pair in pairs.spatial(places, 3) for index in pair)


def test_numbered_photos_are_followed_in_order() -> None:
    names = [f"walk/IMG_{k}.jpg" for k in (10, 9, 8, 11, 12)] + ["other.jpg", "IMG_1.jpg"]
    assert pairs.numbered_runs([usable(name) for name in names]) == [[2, 1, 0, 3, 4]]
    assert pairs.sequential([2, 1, 0, 3, 4], (1,)) == {(1, 2), (0, 1), (0, 3), (3, 4)}


def test_components_of_the_view_graph_are_connected_by_the_likeliest_pairs() -> None:
    components = pairs.connected_components(6, [(0, 1), (1, 2), (3, 4)])
    assert components == [[0, 1, 2], [3, 4], [5]]
    more = pairs.connecting_pairs(components, {(2, 3): 9, (0, 4): 5, (1, 5): 3}, {(0, 3)}, per_photo=1)
    assert more == {(2, 3), (0, 4), (1, 5)}


def test_importing_leaves_sigterm_alone() -> None:
    """COLMAP's own handler would abort with a stack trace."""
    program = "import splatmill_worker.sfm, sys; print('ready', flush=True); sys.stdin.read()"
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert child.stdout is not None
    assert child.stdout.readline() == b"ready\n"
    started = time.monotonic()
    child.terminate()
    _, stderr = child.communicate(timeout=30)
    assert child.returncode == -signal.SIGTERM
    assert stderr == b""
    assert time.monotonic() - started < 30

"""Proves what the photos say of aligned scans: right ones are used, others are refused with the numbers.

The cameras are those of the still life as if they had been recovered, in a world of their own. Does not prove that they
are recovered so from photos, which `test_a_scan_and_photos_alone` does once.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatmill.schema import ModelFrame, TrainOptions
from splatmill_worker import synthetic
from splatmill_worker.errors import Refusal
from splatmill_worker.pipeline import scan_fit
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.given_points import with_given_points
from splatmill_worker.scene import Float, PointViews, Scene, Similarity
from tests.support import still_life
from tests.worker.readers.test_scan import write_las, write_ply

pytestmark = pytest.mark.slow

TURN = Similarity(
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), 250.0, np.array([500_000.0, 5_400_000.0, 300.0])
)
"""From the still life to the scanner's world."""


@cache
def scanned() -> tuple[Float, np.ndarray]:
    return synthetic.scan(120, 90)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The still life as structure from motion returns it: an arbitrary unit, and tracks."""
    capture = still_life.posed_capture(tmp_path_factory.mktemp("capture") / "capture")
    life = still_life.scene()
    views = tuple(replace(view, image=capture / "images" / view.name) for view in life.views)
    frame = ModelFrame(
        unit="arbitrary", from_sfm=np.eye(4).tolist(), reasons={"unit": "The unit is arbitrary."}
    )
    offsets = 2 * np.arange(len(life.points) + 1)
    tracks = PointViews(offsets, np.tile(np.array([0, 1], np.int32), len(life.points)))
    return replace(
        life,
        views=views,
        source="sfm",
        frame=frame,
        point_views=tracks,
        point_errors=np.full(len(life.points), 0.5),
        notes=("The unit is arbitrary.",),
    )


def quiet(stage: str, done: int, total: int, note: str) -> None:
    """Ignore progress."""


def aligned(scene: Scene, points: Float, colors: np.ndarray) -> scan_fit.Fit:
    return scan_fit.aligned(scene, points, colors, None, 0, quiet, lambda: False)


def test_a_scan_of_the_scene_is_used(scene: Scene) -> None:
    points, colors = scanned()
    fit = aligned(scene, TURN.points(points), colors)
    assert fit.fits
    assert fit.alignment is not None
    assert fit.alignment.scale == pytest.approx(1 / 250, rel=0.01)
    assert len(fit.points) > 0.7 * fit.resolved > 0
    back = Similarity.of(np.array(fit.alignment.matrix))
    assert np.median(np.linalg.norm(back.points(TURN.points(points)) - points, axis=1)) < 0.02


def test_a_mirrored_scan_is_refused(scene: Scene) -> None:
    points, colors = scanned()
    fit = aligned(scene, TURN.points(points * np.array([1.0, 1.0, -1.0])), colors)
    assert not fit.fits
    assert "its mirror image fits better" in fit.sentence


def test_a_scan_of_another_scene_is_refused(scene: Scene) -> None:
    """A third of the points on each side: all triangles are tried, and each costs as many comparisons."""
    own = replace(
        scene, points=scene.points[::3], colors=scene.colors[::3], point_views=None, point_errors=None
    )
    points, colors = (each[::3] for each in scanned())
    assert aligned(own, TURN.points(points), colors).fits
    others = np.random.default_rng(0).permutation(len(colors))
    fit = aligned(own, TURN.points(points), colors[others])
    assert not fit.fits


def test_a_file_without_colours_gets_those_of_the_photos_where_its_points_lie(scene: Scene) -> None:
    points, colors = scanned()
    grey = np.full_like(colors, 128)
    posed = replace(scene, frame=None, source="transforms")
    right = scan_fit.as_it_lies(posed, points, grey, None, lambda: False)
    assert right.fits
    _, nearest = cKDTree(points).query(right.points)
    assert np.median(np.abs(right.colors.astype(float) - colors[nearest])) < 25
    wrong = scan_fit.as_it_lies(posed, points[:, [2, 0, 1]], grey, None, lambda: False)
    assert not wrong.fits
    assert "the photos differ by" in wrong.sentence


def test_the_scene_keeps_its_tracks_and_the_scan_gets_some(scene: Scene, tmp_path: Path) -> None:
    points, colors = scanned()
    write_las(tmp_path / "scan.laz", TURN.points(points), colors)
    result = with_given_points(scene, tmp_path / "scan.laz", TrainOptions(), quiet, lambda: False)
    own, used = len(scene.points), result.facts["given_points_used"]
    assert len(result.points) == own + used
    assert result.facts["sparse_points"] == own
    assert result.point_views is not None
    assert result.point_views.views[: 2 * own].tolist() == [0, 1] * own
    added = np.diff(result.point_views.offsets)[own:]
    assert 2 < np.median(added) < len(scene.views)
    assert result.point_errors is not None
    assert np.isfinite(result.point_errors).sum() == own
    assert result.frame is not None
    assert result.frame.unit == "arbitrary"  # nothing says that the numbers of a .laz are metres


def test_a_format_in_metres_gives_the_scene_its_unit(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, colors = scanned()
    write_ply(tmp_path / "scan.ply", TURN.points(points), colors)
    monkeypatch.setattr("splatmill_worker.readers.scan.IN_METRES", (".ply",))
    result = with_given_points(scene, tmp_path / "scan.ply", TrainOptions(), quiet, lambda: False)
    assert result.frame is not None
    assert result.frame.unit == "metre"
    assert result.frame.reasons["unit"] == "Metres, because those of scan.ply are."
    assert "The unit is arbitrary." not in result.notes
    assert np.cbrt(np.linalg.det(np.array(result.frame.from_sfm)[:3, :3])) == pytest.approx(250, rel=0.01)
    grown = np.linalg.norm(result.centers[3] - result.centers[0]) / np.linalg.norm(
        scene.centers[3] - scene.centers[0]
    )
    assert grown == pytest.approx(250, rel=0.01)
    alignment = result.facts["given_points_alignment"]
    assert alignment["scale"] == 1.0
    matrix = Similarity.of(np.array(alignment["matrix"]))
    used = matrix.points(TURN.points(points))
    far, _ = cKDTree(used).query(result.points)
    assert np.median(far) < 250 * 0.1


@pytest.mark.parametrize(
    "points", [np.zeros((1, 3)), np.ones((400, 3)), np.eye(3)[[0] * 400] * np.arange(400)[:, None]]
)
def test_a_file_that_determines_nothing_is_refused(points: Float, scene: Scene, tmp_path: Path) -> None:
    colors = np.random.default_rng(0).integers(1, 255, points.shape).astype(np.uint8)
    colors[0] = 0
    write_ply(tmp_path / "scan.ply", points, colors)
    with pytest.raises(Refusal) as refused:
        with_given_points(scene, tmp_path / "scan.ply", TrainOptions(), quiet, lambda: False)
    assert refused.value.code == "start_unusable"
    assert "do not fit the photos" in refused.value.message


def test_the_number_of_points_follows_the_photos(scene: Scene) -> None:
    assert scan_fit.most(scene.views, None) == 20_000
    large = [replace(view, camera=view.camera.scaled_to(4000, 3000)) for view in scene.views]
    # 14 photos of 12 million pixels, 50 for each Gaussian, a fifth of these: more than the limit of 200,000.
    assert scan_fit.most(large, None) == 200_000
    assert scan_fit.most(large, 1000) == pytest.approx(0.2 * 14 * 750_000 / 50, abs=1)


def test_a_scan_without_colours_is_not_aligned(scene: Scene) -> None:
    points, colors = scanned()
    fit = aligned(scene, TURN.points(points), np.full_like(colors, 128))
    assert not fit.fits
    assert "They have no colours" in fit.sentence


def test_a_scan_and_photos_alone(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    truth = synthetic.capture(capture / "images", 12, 320, 240, samples=1)
    (capture / "poses").mkdir()
    points, colors = scanned()
    write_las(capture / "poses" / "scan.laz", TURN.points(points), colors)
    result = posed_scene(
        capture, tmp_path / "work", TrainOptions(start="scan.laz"), lambda *_: None, lambda: False
    )
    alignment = result.facts["given_points_alignment"]
    to_model = TURN.then(Similarity.of(np.array(alignment["matrix"])))
    for view in result.views:
        apart = np.linalg.norm(to_model.points(truth[view.name].center) - view.camera.center)
        assert apart < 0.02 * to_model.scale * np.linalg.norm(truth[view.name].center)
    assert result.facts["given_points_used"] > 5000

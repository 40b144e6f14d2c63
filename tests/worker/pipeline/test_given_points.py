"""Proves that a training starts from the points of a scan where the photos show them, and is refused where they do not.

The scan is simulated on the still life: true surfaces with the noise of a scanner's ranges. Does not prove that a
training gains from it.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.errors import Refusal
from splatmill_worker.pipeline import given_points
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.first_gaussians import start_model_path
from splatmill_worker.readers import scan
from splatmill_worker.scene import Scene
from splatmill_worker.splat.formats import ply
from tests.support import gaussians, still_life
from tests.worker.readers.test_scan import write_las, write_ply

OFFSET = (500_000.0, 5_400_000.0, 300.0)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The photos of the still life with cameras in UTM-like coordinates."""
    return still_life.posed_capture(tmp_path / "capture", OFFSET)


def scanned(noise: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    scene = still_life.scene()
    random = np.random.default_rng(1)
    return scene.points + np.array(OFFSET) + random.normal(0, noise, scene.points.shape), scene.colors


def load(capture: Path, tmp_path: Path, start: str) -> Scene:
    return posed_scene(capture, tmp_path / "work", TrainOptions(start=start), lambda *_: None, lambda: False)


@pytest.mark.parametrize("name", ["scan.laz", "scan.ply"])
def test_points_of_a_scan_come_beside_those_of_the_photos(name: str, capture: Path, tmp_path: Path) -> None:
    points, colors = scanned()
    (write_las if name.endswith("z") else write_ply)(capture / "poses" / name, points, colors)
    poses = json.loads((capture / "poses" / "transforms.json").read_text())
    (capture / "poses" / "transforms.json").write_text(json.dumps({**poses, "ply_file_path": "own.ply"}))
    write_ply(capture / "poses" / "own.ply", points[:100] + np.array((0, 0, 1e-3)), colors[:100])
    scene = load(capture, tmp_path, name)
    assert scene.facts["given_points"] == len(points)
    used = scene.facts["given_points_used"]
    assert used > 0.8 * len(points)
    near = np.abs(scene.points[-used:, None] - points[None]).max(axis=2).min(axis=1)
    assert near.max() < 1e-3
    assert len(scene.points) > used + 50  # a scan has holes, so that the data set's own points stay
    assert f"{name} holds {len(points):,} points. One for each cell of 1.0 pixels" in scene.notes[-1]
    assert f"of which {used:,} are used" in scene.notes[-1]
    assert used <= scene.facts["given_points_resolved"] <= len(points)
    assert "given_points_alignment" not in scene.facts
    assert start_model_path(capture, tmp_path, TrainOptions(start=name)) is None


def test_a_scan_beside_a_zip_of_photos_and_cameras(capture: Path, tmp_path: Path) -> None:
    zipped = tmp_path / "zipped"
    (zipped / "images").mkdir(parents=True)
    (zipped / "poses").mkdir()
    shutil.make_archive(str(zipped / "images" / "all"), "zip", capture)
    write_las(zipped / "poses" / "scan.laz", *scanned())
    assert load(zipped, tmp_path, "scan.laz").facts["given_points_used"] > 1000


@pytest.mark.slow
@pytest.mark.parametrize("change", ["axes", "units"])
def test_points_elsewhere_are_aligned(change: str, capture: Path, tmp_path: Path) -> None:
    points, colors = scanned()
    local = points - np.array(OFFSET)
    scale = 1000.0 if change == "units" else 1.0
    points = np.array(OFFSET) + scale * (local[:, [1, 2, 0]] if change == "axes" else local)
    write_ply(capture / "poses" / "scan.ply", points, colors)
    own = with_own_points(capture)
    scene = load(capture, tmp_path, "scan.ply")
    alignment = scene.facts["given_points_alignment"]
    assert alignment["scale"] == pytest.approx(1.0 / scale, rel=0.01)
    assert alignment["share"] > 0.9
    used = scene.facts["given_points_used"]
    assert used > 0.7 * len(points)
    off = np.linalg.norm(scene.points[-used:, None] - own[None, ::3], axis=2).min(axis=1)
    assert np.median(off) < 0.1
    assert "scan.ply was aligned to the photos" in scene.notes[-1]
    assert scene.frame is None  # given cameras are never moved


def with_own_points(capture: Path) -> np.ndarray:
    """The points that the data set gets of its own, all over the scene."""
    random = np.random.default_rng(2)
    life = still_life.scene()
    points: np.ndarray = life.points + np.array(OFFSET) + random.normal(0, 0.002, life.points.shape)
    poses = json.loads((capture / "poses" / "transforms.json").read_text())
    (capture / "poses" / "transforms.json").write_text(json.dumps({**poses, "ply_file_path": "own.ply"}))
    write_ply(capture / "poses" / "own.ply", points, life.colors)
    return points


@pytest.mark.slow
def test_a_scan_of_another_place_is_refused_with_the_share(capture: Path, tmp_path: Path) -> None:
    with_own_points(capture)
    random = np.random.default_rng(0)
    walls = random.uniform(-2, 2, (3000, 3))
    walls[:1500, 0], walls[1500:, 1] = 2.0, 1.0
    colors = np.random.default_rng(1).integers(0, 255, walls.shape).astype(np.uint8)
    write_ply(capture / "poses" / "scan.ply", walls, colors)
    with pytest.raises(Refusal) as refused:
        load(capture, tmp_path, "scan.ply")
    assert refused.value.code == "start_unusable"
    assert (
        "The points of scan.ply do not fit the photos. As they lie: The photos show" in refused.value.message
    )
    assert "% of the points of the photos lie on them" in refused.value.message


def test_cameras_without_points_of_their_own_align_nothing(capture: Path, tmp_path: Path) -> None:
    points, colors = scanned()
    write_ply(capture / "poses" / "scan.ply", points * 1000.0, colors)
    for photo in (capture / "images").iterdir():
        Image.new("RGB", (still_life.WIDTH, still_life.HEIGHT), (90, 90, 90)).save(photo)
    with pytest.raises(Refusal, match="of the cloud of the photos, it has 0 distinct points"):
        load(capture, tmp_path, "scan.ply")


def test_a_ply_with_gaussians_is_a_model(capture: Path, tmp_path: Path) -> None:
    ply.write(capture / "poses" / "model.ply", gaussians.some_gaussians(20, 1))
    options = TrainOptions(start="model.ply")
    assert given_points.points_path(capture, options) is None
    assert start_model_path(capture, tmp_path, options) == capture / "poses" / "model.ply"


def test_a_library_that_is_missing_is_named(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_las(capture / "poses" / "scan.laz", *scanned())
    monkeypatch.setitem(scan.LIBRARIES, ".laz", ("laspy", "no_such_module"))
    with pytest.raises(Refusal, match="the Python module no_such_module is not installed"):
        load(capture, tmp_path, "scan.laz")


@pytest.mark.parametrize("data", [b"", b"LASF", b"1 2\n3 4\n"])
def test_a_file_without_points_is_refused(data: bytes, capture: Path, tmp_path: Path) -> None:
    for name in ("scan.las", "scan.xyz", "scan.e57", "scan.pcd"):
        (capture / "poses" / name).write_bytes(data)
        with pytest.raises(Refusal) as refused:
            load(capture, tmp_path, name)
        assert refused.value.code == "start_unusable"
        assert name in refused.value.message


def test_no_library_of_scans_is_imported_without_one() -> None:
    code = (
        "import sys, splatmill_worker.pipeline.stages; "
        "print([name for name in ('laspy', 'lazrs', 'pye57', 'pypcd4') if name in sys.modules])"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )

"""Proves that depth maps of posed photos give points on the surface, in the unit of the cameras' world, or a reason.

The maps are what a depth camera would measure of the still life: noise, wrong distances of low confidence at edges, and
nothing of the dome. Does not prove anything about files of other makers than those that their documentation describes.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import ModelFrame, TrainOptions
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.depth.given_depth import with_depth
from splatmill_worker.pipeline.stages import run
from splatmill_worker.scene import Camera, Scene, Similarity
from tests.support.scenes import depth_sets

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    folder = tmp_path_factory.mktemp("depth") / "made"
    return folder, depth_sets.data_set(folder)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that keeps the points of the photos."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def scene(made: tuple[Path, dict[str, Camera]], work: Path) -> Scene:
    """The scene before its depth maps are read."""
    scene = posed_scene(made[0], work, TrainOptions(), lambda *_: None, lambda: False)
    # Each test has a copy of the maps, which are found by their names.
    return replace(scene, views=tuple(replace(view, depth=None) for view in scene.views))


@pytest.fixture
def capture(made: tuple[Path, dict[str, Camera]], tmp_path: Path) -> Path:
    return Path(shutil.copytree(made[0], tmp_path / "capture"))


def read(scene: Scene, capture: Path, tmp_path: Path, held_out: tuple[str, ...] = ()) -> Scene:
    training = {view.name for view in scene.views} - set(held_out)
    return with_depth(
        scene, training, capture, tmp_path / "work", TrainOptions(), lambda *_: None, lambda: False
    )


def changed(capture: Path, change: Callable[[np.ndarray], np.ndarray], which: str = "*.png") -> None:
    for path in sorted((capture / "depth").glob(which)):
        Image.fromarray(change(np.array(Image.open(path)))).save(path)


def test_points_lie_on_the_surface(
    made: tuple[Path, dict[str, Camera]], scene: Scene, capture: Path, tmp_path: Path
) -> None:
    result = read(scene, capture, tmp_path, ("00.png",))
    own, used = len(scene.points), result.facts["depth_points_used"]
    assert result.facts["depth_maps"] == len(scene.views) - 1  # none of a held-out photo
    assert used > 5000
    assert len(result.points) == own + used
    errors = depth_sets.off_surface(result.points[own:], made[1])
    assert np.quantile(errors, 0.5) < depth_sets.NOISE
    assert np.quantile(errors, 0.98) < 0.02
    assert result.facts["depth_unit"] == 1e-3  # as the file says, and not as measured
    assert result.facts["depth_unit_spread"] < 0.02
    assert f"of which {used:,} are used: photos show their colours." in result.notes[-1]
    assert result.warnings == scene.warnings
    assert result.left_out == ()
    assert result.point_views is None or len(result.point_views.offsets) == len(result.points) + 1


def test_pixels_of_low_confidence_are_left_out(scene: Scene, capture: Path, tmp_path: Path) -> None:
    """Of the levels of Stray Scanner too; what is under the highest that occurs does not count."""
    for path in (capture / "confidence").iterdir():
        levels = np.full((72, 96), 1, np.uint8)
        levels[:, :48] = 2
        Image.fromarray(levels).save(path)
    half = read(scene, capture, tmp_path)
    for view in scene.views:
        Image.fromarray(np.zeros((36, 48), np.uint8)).save(capture / "confidence" / view.name)
    none = read(scene, capture, tmp_path)
    shutil.rmtree(capture / "confidence")
    everything = read(scene, capture, tmp_path)
    assert 0.4 < half.facts["depth_points"] / everything.facts["depth_points"] < 0.6
    assert len(none.points) == len(scene.points)
    assert none.warnings[-1] == (
        "The depth maps are not used: none of their pixels has the highest confidence."
    )


def five_times(levels: np.ndarray) -> np.ndarray:
    """Levels of 1/5000 of what was a thousand; what is farther than 16 bits reach gets the largest."""
    return np.minimum(5 * levels.astype(np.uint32), 65535).astype(np.uint16)


@pytest.mark.parametrize(
    ("change", "stated", "length"),
    [
        (lambda levels: levels, None, 1e-3),
        (five_times, None, 2e-4),
        (five_times, 1e-3, 2e-4),
    ],
    ids=["millimetres", "as of TUM", "as of TUM, called millimetres"],
)
def test_the_unit_is_measured_by_the_points_of_the_photos(
    scene: Scene,
    capture: Path,
    tmp_path: Path,
    change: Callable[[np.ndarray], np.ndarray],
    stated: float | None,
    length: float,
) -> None:
    changed(capture, change)
    result = read(replace(scene, depth_unit=stated), capture, tmp_path)
    assert result.facts["depth_unit"] == pytest.approx(length, rel=0.01)
    assert result.facts["depth_points_used"] > 5000
    assert ("the cameras say 0.001, which differs by a factor of 0.2" in result.notes[-1]) == bool(stated)


def test_a_unit_that_cannot_be_told_is_refused_with_both_readings(
    scene: Scene, capture: Path, tmp_path: Path
) -> None:
    few = replace(scene, points=scene.points[:1], colors=scene.colors[:1], point_views=None, depth_unit=None)
    result = read(few, capture, tmp_path)
    assert len(result.points) == 1
    said = result.warnings[-1]
    assert "their unit is not stated" in said
    assert " m (in millimetres) or " in said
    assert "as of TUM RGB-D" in said
    assert "depth_unit_scale_factor" in said


def test_maps_of_other_photos_are_refused(scene: Scene, capture: Path, tmp_path: Path) -> None:
    paths = sorted((capture / "depth").iterdir())
    levels = [path.read_bytes() for path in paths]
    for path, other in zip(paths, levels[5:] + levels[:5], strict=True):
        path.write_bytes(other)
    shutil.rmtree(capture / "confidence")
    result = read(scene, capture, tmp_path)
    assert len(result.points) == len(scene.points)
    assert "The depth maps are not used: they do not show the distances of the scene" in result.warnings[-1]


def test_inverse_depths_are_refused(scene: Scene, capture: Path, tmp_path: Path) -> None:
    changed(capture, lambda levels: np.where(levels > 0, 1e7 / np.maximum(levels, 200), 0).astype(np.uint16))
    result = read(replace(scene, depth_unit=None), capture, tmp_path)
    assert len(result.points) == len(scene.points)
    assert "inverse or relative depths" in result.warnings[-1]


def test_a_wrong_unit_without_points_is_refused_by_the_photos(
    scene: Scene, capture: Path, tmp_path: Path
) -> None:
    bare = replace(scene, points=scene.points[:0], colors=scene.colors[:0], point_views=None)
    right = read(bare, capture, tmp_path)
    assert right.facts["depth_points_used"] > 5000
    wrong = read(replace(bare, depth_unit=2e-4), capture, tmp_path)
    assert len(wrong.points) == 0
    assert "The other photos show their colours at" in wrong.warnings[-1]


def test_one_map_of_another_photo_is_left_out(scene: Scene, capture: Path, tmp_path: Path) -> None:
    changed(capture, lambda levels: (0.6 * levels).astype(np.uint16), "03.png")
    result = read(scene, capture, tmp_path)
    assert result.facts["depth_maps"] == len(scene.views) - 1
    assert "1 depth map is not used" in result.warnings[-1]
    assert "of 03.png" in result.warnings[-1]


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def saved(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], Any]:
    return lambda path: Image.fromarray(make(np.array(Image.open(path)))).save(path)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (cut_off, "it does not decode completely"),
        (saved(lambda levels: levels[:, :60].copy()), "it has 60 x 72 pixels, another shape than its photo"),
        (
            saved(lambda levels: (levels >> 8).astype(np.uint8)),
            "it has 8 bits per channel, as a depth map has",
        ),
        (
            saved(lambda levels: np.zeros((72, 96, 3), np.uint8)),
            "it has 8 bits per channel, as a depth map has",
        ),
        (saved(np.zeros_like), "none of its pixels is a distance: all are 0, 65535 or not finite"),
    ],
    ids=["cut off", "cropped", "8 bits", "colours", "zero"],
)
def test_a_damaged_map_is_named(
    scene: Scene, capture: Path, tmp_path: Path, damage: Callable[[Path], Any], reason: str
) -> None:
    damage(capture / "depth" / "03.png")
    result = read(scene, capture, tmp_path)
    assert result.facts["depth_maps"] == len(scene.views) - 1
    assert f"The depth map depth/03.png is not used: {reason}" in result.warnings[-1]
    for path in (capture / "depth").iterdir():
        if path.name != "03.png":
            damage(path)
    result = read(scene, capture, tmp_path)
    assert len(result.points) == len(scene.points)
    assert (
        f"All {len(scene.views)} depth maps are not used, such as depth/00.png: {reason}"
        in result.warnings[-1]
    )


def test_floating_point_maps_with_holes_that_are_no_numbers(
    made: tuple[Path, dict[str, Camera]], scene: Scene, capture: Path, tmp_path: Path
) -> None:
    for path in (capture / "depth").iterdir():
        metres = np.array(Image.open(path)).astype(np.float32) / 1000.0
        metres[metres == 0.0] = np.nan
        metres[:4] = np.inf
        Image.fromarray(metres).save(path.with_suffix(".tiff"))
        path.unlink()
    result = read(replace(scene, depth_unit=None), capture, tmp_path)
    assert result.facts["depth_unit"] == pytest.approx(1.0, rel=0.01)
    errors = depth_sets.off_surface(result.points[len(scene.points) :], made[1])
    assert np.isfinite(result.points).all()
    assert np.quantile(errors, 0.98) < 0.02


def test_maps_that_frames_name_lie_in_any_folder(
    made: tuple[Path, dict[str, Camera]], capture: Path, tmp_path: Path
) -> None:
    (capture / "depth").rename(capture / "sensor")
    document = json.loads((capture / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["depth_file_path"] = frame["depth_file_path"].replace("depth/", "./sensor/")
    (capture / "transforms.json").write_text(json.dumps(document))
    scene = posed_scene(capture, tmp_path / "work", TrainOptions(), lambda *_: None, lambda: False)
    assert scene.depth_unit == 1e-3
    result = read(scene, capture, tmp_path)
    assert result.facts["depth_maps"] == len(scene.views)
    assert result.left_out == ()


def test_maps_that_belong_to_no_photo_are_named(scene: Scene, capture: Path, tmp_path: Path) -> None:
    for path in (capture / "depth").iterdir():
        path.rename(path.with_name(f"frame_{path.name}"))
    result = read(scene, capture, tmp_path)
    assert "14 depth maps (such as depth/frame_00.png) belong to no photo by name" in result.warnings[-1]


def test_recovered_cameras_get_the_metres_of_a_phone(
    made: tuple[Path, dict[str, Camera]], scene: Scene, capture: Path, tmp_path: Path
) -> None:
    """Structure from motion has an arbitrary unit; depth maps with confidence are in millimetres."""
    turn = Similarity(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), 0.4, np.array([3.0, -2.0, 1.0]))
    frame = ModelFrame(unit="arbitrary", from_sfm=np.eye(4).tolist(), reasons={"unit": "It is arbitrary."})
    recovered = replace(
        turn.apply(scene), source="sfm", frame=frame, depth_unit=None, notes=("It is arbitrary.",)
    )
    result = read(recovered, capture, tmp_path)
    assert result.frame is not None
    assert result.frame.unit == "metre"
    assert "millimetres" in result.frame.reasons["unit"]
    assert result.notes[0] == result.frame.reasons["unit"]
    true = [np.linalg.norm(view.camera.center) for view in scene.views]
    middle = turn.points(np.zeros((1, 3)))[0] / 0.4
    there = [np.linalg.norm(view.camera.center - middle) for view in result.views]
    np.testing.assert_allclose(there, true, rtol=0.01)


def test_a_training_starts_from_depth_maps_and_gains(
    scene: Scene, work: Path, capture: Path, tmp_path: Path
) -> None:
    """At the same number of steps, held-out photos are shown no worse; here, by more than a decibel better."""
    options = TrainOptions.model_validate({"steps": 60, "image_size": 192, "backend": "cpu", "lpips": "off"})
    psnr = {}
    for name in ("with", "without"):
        shutil.copytree(work, tmp_path / name)
        outcome = run(capture, tmp_path / name, options, lambda event: None, lambda: False)
        assert outcome.ended == "succeeded"
        report = json.loads((outcome.out / "report.json").read_text())
        psnr[name] = report["result"]["psnr"]
        shutil.rmtree(capture / "depth", ignore_errors=True)
    assert psnr["with"] > psnr["without"] + 1.0

"""Proves that a scene with two alike sides is not folded onto itself where the order of its photos is known.

Proven on generated photos of a can whose label is printed twice, whose true cameras are known, and on a real one. Does
not prove that photos in no order, or with a break in their order between the sides, are kept apart.
"""

import math
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Scene
from splatmill_worker.sfm import solve, unfold
from splatmill_worker.sfm.agreement import Poses, agreement
from splatmill_worker.sfm.run import UNFOLDED, EffortResult, SfmRun
from splatmill_worker.synthetic.ray_caster import Cylinder, Disc, StillLife, look_at, picture
from splatmill_worker.synthetic.textures import MipMap, painted, sky
from tests.support.paths import DATA
from tests.support.scenes.poses import pose_errors

pytestmark = pytest.mark.slow

COUNT = 30


def reconstruct(images: Path, workdir: Path) -> Scene:
    options = sfm.SfmOptions(effort="standard", stereo=False)
    return sfm.reconstruct(images, None, workdir, options, lambda *_: None, lambda: False)


def turns(scene: Scene) -> np.ndarray:
    """Degrees between the directions of each two neighbouring photos, by name."""
    rotations = [view.camera.viewmat[:3, :3] for view in sorted(scene.views, key=lambda view: view.name)]
    cosines = np.array([(np.trace(b @ a.T) - 1.0) / 2.0 for a, b in pairwise(rotations)])
    degrees: np.ndarray = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return degrees


@pytest.fixture(scope="module")
def can(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    """Photos of one turn around a can on a round table; the label goes around it exactly twice."""
    rng = np.random.default_rng(3)
    label, table = MipMap(painted(rng, 512, density=150)), MipMap(painted(rng, 1024, density=60))
    solids = (Disc(0.0, 1.9, table, 0.27), Cylinder((0.0, 0.0, 0.9), 0.8, 0.9, label, 1.0 / (0.8 * math.pi)))
    scene = StillLife(solids, MipMap(sky(rng, 256)), np.array([0.44, -0.34, 0.83]))
    folder = tmp_path_factory.mktemp("can") / "images"
    folder.mkdir()
    cameras = {}
    for number in range(COUNT):
        angle, rise = 2.0 * math.pi * number / COUNT, 0.25 + 0.05 * math.sin(number)
        eye = 3.4 * np.array(
            [math.cos(angle) * math.cos(rise), math.sin(angle) * math.cos(rise), math.sin(rise)]
        )
        camera = look_at(eye, np.array([0.0, 0.0, 0.75]), 320, 240, 288.0)
        cameras[f"can_{number:04d}.jpg"] = camera
        Image.fromarray(picture(scene, camera, 1)).save(folder / f"can_{number:04d}.jpg", quality=95)
    return folder, cameras


@pytest.fixture(scope="module")
def solved(
    can: tuple[Path, dict[str, Camera]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Scene, Path]:
    """The scene of the can, and its work folder."""
    workdir = tmp_path_factory.mktemp("solved")
    return reconstruct(can[0], workdir), workdir


@pytest.fixture
def matched(solved: tuple[Scene, Path], tmp_path: Path) -> Path:
    """A work folder with the features and the matches of the can, and no model."""
    workdir = tmp_path / "matched"
    shutil.copytree(solved[1], workdir, ignore=shutil.ignore_patterns("model-*", UNFOLDED))
    return workdir


def test_a_can_with_two_alike_sides_keeps_both(
    can: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    scene, _ = solved
    assert len(scene.views) == COUNT
    assert scene.facts["pairs_alike"] > 0
    (note,) = [note for note in scene.notes if "look alike" in note]
    assert "mapped again without these pairs" in note
    assert "can_00" in note
    rotations, positions = pose_errors(scene, can[1])
    assert rotations.max() < 3.0
    assert positions.max() < 0.05


def test_without_the_check_the_sides_lie_on_each_other(
    can: tuple[Path, dict[str, Camera]], matched: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solve, "unfold", lambda *_: None)
    scene = reconstruct(can[0], matched)
    assert turns(scene).max() > 90.0
    assert pose_errors(scene, can[1])[0].max() > 90.0


def test_where_too_few_photos_would_be_left_the_model_is_kept_and_doubted(
    can: tuple[Path, dict[str, Camera]], matched: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[EffortResult] = []

    def keep(run: SfmRun, result: EffortResult) -> None:
        unfold.unfold(run, result)
        kept.append(result)

    monkeypatch.setattr(unfold, "KEPT_REGISTERED", 2.0)
    monkeypatch.setattr(solve, "unfold", keep)
    scene = reconstruct(can[0], matched)
    (note,) = [note for note in scene.notes if "look alike" in note]
    assert "gave no better cameras" in note
    assert scene.facts["pairs_alike"] == 0
    (result,) = kept
    assert result.view_graph == result.database
    assert result.mapped is not None
    assert result.mapped.largest is not None
    poses = Poses(result.mapped.largest)
    database = pycolmap.Database.open(result.database)
    try:
        shares = {pair: agreement(poses, result, database, pair) for pair in result.verified}
    finally:
        database.close()
    opposite = [share for (first, second), share in shares.items() if 13 <= second - first <= 17]
    near = [share for (first, second), share in shares.items() if second - first == 1]
    assert np.median(opposite) > 0.9
    assert min(near) < unfold.CONTRADICTED
    assert np.median(near) > 0.9


def test_photos_of_one_side_are_mapped_once(
    can: tuple[Path, dict[str, Camera]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    side = tmp_path / "images"
    side.mkdir()
    for photo in sorted(can[0].iterdir())[: COUNT // 3]:
        shutil.copy(photo, side)
    monkeypatch.setattr(unfold, "best_mapping", lambda *_: pytest.fail("mapped again"))
    scene = reconstruct(side, tmp_path / "work")
    assert len(scene.views) == COUNT // 3
    assert scene.facts["pairs_alike"] == 0
    assert turns(scene).max() < 30.0


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data folder is not beside the project")
def test_a_real_can_with_its_label_on_both_sides_keeps_both(tmp_path: Path) -> None:
    scene = reconstruct(DATA / "beer_720/images", tmp_path)
    assert len(scene.views) == 71
    assert scene.facts["pairs_alike"] > 0
    assert turns(scene).max() < 30.0  # 3 to 14 degrees; folded, three of 170

"""Proves structure from motion on real and generated photos: poses against the truth, named failures, caching and
cancelling.

Not proven here: speed and quality on larger sets, which `bench sfm` measures.
"""

import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill.schema import KnownDistance
from splatmill_worker import sfm, synthetic
from splatmill_worker.errors import Cancelled, Refusal
from splatmill_worker.scene import Camera, Scene
from tests.support.paths import DATA
from tests.support.scenes.poses import pose_errors

pytestmark = pytest.mark.slow

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data folder is not beside the project")


def quiet(stage: str, done: int, total: int, note: str) -> None:
    pass


def reconstruct(images: Path, workdir: Path, **options: Any) -> Scene:
    return sfm.reconstruct(images, None, workdir, sfm.SfmOptions(**options), quiet, lambda: False)


@pytest.fixture(scope="module")
def still_life(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    folder = tmp_path_factory.mktemp("still") / "images"
    return folder, synthetic.capture(folder, 16, 400, 300, samples=1)


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
    rotations, positions = pose_errors(scene, still_life[1])
    assert np.median(rotations) < 0.3
    assert np.median(positions) < 0.01
    true = next(iter(still_life[1].values()))
    assert scene.views[0].camera.fx == pytest.approx(true.fx, rel=0.03)
    assert scene.facts["registered"] == 16
    assert scene.facts["pairs_alike"] == 0
    assert scene.colors.std() > 10  # painted from the photos, not left black
    assert scene.point_views is not None
    assert scene.point_views.views.max() < 16
    assert scene.facts["stereo_points"] > 0
    assert scene.facts["seconds"]["stereo"] >= 0.9 * scene.facts["stereo_seconds"]


def test_the_same_photos_are_read_back(
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


def test_the_scene_stands_upright_and_centred(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    """In the world of the still life z points up, and its photos look at the middle of its table."""
    scene, _ = solved
    assert scene.frame is not None
    assert scene.frame.reasons["up"] == "Up is where 16 of 16 photos are held level."
    tilts = []
    for view in scene.views:
        true = still_life[1][view.name].viewmat[:3, :3] @ [0.0, 0.0, -1.0]
        tilts.append(math.degrees(math.acos(np.clip(view.camera.viewmat[:3, 1] @ true, -1.0, 1.0))))
    assert np.median(tilts) < 1.5
    assert np.median(np.linalg.norm(scene.centers, axis=1)) == pytest.approx(1.0, abs=1e-6)


def test_a_known_distance_scales_a_stored_model(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path], tmp_path: Path
) -> None:
    scene, workdir = solved
    shutil.copytree(workdir, tmp_path / "work")
    first, last = scene.views[0].name, scene.views[8].name
    known = KnownDistance(first, last, 3.0)
    scaled = sfm.reconstruct(
        still_life[0], None, tmp_path / "work", sfm.SfmOptions(), quiet, lambda: False, known=known
    )
    assert np.linalg.norm(scaled.centers[0] - scaled.centers[8]) == pytest.approx(3.0)
    with pytest.raises(Refusal, match=r"scale names nowhere\.png, and there is no such photo among the 16"):
        sfm.reconstruct(
            still_life[0],
            None,
            tmp_path / "work",
            sfm.SfmOptions(),
            quiet,
            lambda: False,
            known=KnownDistance(first, "nowhere.png", 1.0),
        )


def test_a_stored_model_that_is_damaged_is_recovered_anew(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path], tmp_path: Path
) -> None:
    first, workdir = solved
    shutil.copytree(workdir, tmp_path / "work")
    (facts,) = (tmp_path / "work").glob("sfm/*/model-*/facts.json")
    facts.write_text("{")
    stages: list[str] = []
    again = sfm.reconstruct(
        still_life[0],
        None,
        tmp_path / "work",
        sfm.SfmOptions(),
        lambda stage, *_: stages.append(stage),
        lambda: False,
    )
    assert "mapping" in stages
    assert "features" not in stages
    assert len(again.views) == len(first.views)


def test_a_cancelled_run_continues_from_what_it_stored(
    still_life: tuple[Path, dict[str, Camera]], tmp_path: Path
) -> None:
    stages: list[str] = []

    def watch(stage: str, done: int, total: int, note: str) -> None:
        stages.append(stage)

    # A raised effort would look for features again; stereo comes after all that is continued.
    lean = sfm.SfmOptions(effort="lean", stereo=False)
    with pytest.raises(Cancelled):
        sfm.reconstruct(still_life[0], None, tmp_path, lean, watch, lambda: "matching" in stages)
    assert "mapping" not in stages
    before = len(stages)
    scene = sfm.reconstruct(still_life[0], None, tmp_path, lean, watch, lambda: False)
    assert "features" not in stages[before:]
    assert len(scene.views) >= 14


def test_the_global_mapper_finds_the_cameras_too(
    still_life: tuple[Path, dict[str, Camera]], solved: tuple[Scene, Path]
) -> None:
    scene = reconstruct(still_life[0], solved[1], mapper="global", stereo=False)
    assert scene.facts["mapper"] == "global"
    assert len(scene.views) >= 14
    assert np.median(pose_errors(scene, still_life[1])[0]) < 0.5


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
def test_all_photos_of_a_real_capture_are_registered(tmp_path: Path) -> None:
    scene = reconstruct(DATA / "kermit_640x480/images", tmp_path, stereo=False)
    assert len(scene.views) == 11
    assert scene.facts["reprojection_pixels"] < 1.0
    assert scene.left_out == ()


@needs_data
@pytest.mark.parametrize(
    ("folder", "code"),
    [("failure_unrelated_640", "sfm_too_few_registered"), ("failure_pure_rotation", "sfm_no_parallax")],
)
def test_photos_without_overlap_or_parallax_are_refused_by_name(
    tmp_path: Path, folder: str, code: str
) -> None:
    with pytest.raises(sfm.SfmFailed) as failed:
        reconstruct(DATA / folder / "images", tmp_path)
    assert failed.value.code == code
    assert failed.value.facts["photos"] == len(list((DATA / folder / "images").iterdir()))
    assert failed.value.advice


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

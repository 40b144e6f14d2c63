"""Photos of the same bytes with different given cameras are left out by name, whatever file has the cameras, and
refused where most are such; two estimates of one camera, and photos that show nothing, are kept.

Does not prove which camera is right: none is taken for that.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.files.program_files import PROGRAMS, SIZE
from tests.support.posed_sets import (
    ALL,
    COUNT,
    NAMES,
    check,
    frames,
    loaded,
    model,
    photos,
    transforms,
    viewmat,
)

WRITERS: dict[str, Callable[[Path], object]] = {
    "transforms.json": lambda folder: transforms(folder / "transforms.json"),
    "COLMAP": lambda folder: model(folder / "sparse/0"),
    "VisualSFM": lambda folder: PROGRAMS["VisualSFM"].write(
        folder, [viewmat(k) for k in range(COUNT)], NAMES
    ),
}


def noise(folder: Path, program: str = "") -> None:
    folder.mkdir(parents=True)
    size = SIZE if program == "VisualSFM" else (64, 48)
    for k, name in enumerate(NAMES):
        pixels = np.random.default_rng(k).integers(0, 255, (size[1] // 8, size[0] // 8, 3), np.uint8)
        Image.fromarray(pixels).resize(size).save(folder / name)


@pytest.mark.parametrize("program", WRITERS)
def test_neither_of_two_is_used_and_both_are_named(tmp_path: Path, program: str) -> None:
    noise(tmp_path / "images", program)
    shutil.copy(tmp_path / "images" / NAMES[3], tmp_path / "images" / NAMES[9])
    WRITERS[program](tmp_path)
    scene = loaded(tmp_path)
    assert {view.name for view in scene.views} == set(NAMES) - {NAMES[3], NAMES[9]}
    (warning,) = (text for text in scene.warnings if "bytes" in text)
    assert warning.startswith("2 photos with given cameras have the same bytes as another one")
    assert f": {NAMES[3]}, {NAMES[9]}. " in warning
    assert dict(scene.left_out) == {
        one: f"its bytes are those of {other}, to which a different camera is given"
        for one, other in ((NAMES[3], NAMES[9]), (NAMES[9], NAMES[3]))
    }


def test_a_camera_that_was_turned_is_a_different_one(tmp_path: Path) -> None:
    noise(tmp_path / "images")
    shutil.copy(tmp_path / "images" / NAMES[3], tmp_path / "images" / NAMES[9])
    of = frames()
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    of[9]["transform_matrix"] = (np.array(of[3]["transform_matrix"]) @ turn).tolist()
    transforms(tmp_path / "transforms.json", of)
    assert len(loaded(tmp_path).views) == COUNT - 2


def test_most_photos_of_the_same_bytes_are_refused(tmp_path: Path) -> None:
    noise(tmp_path / "images")
    for name in NAMES[1:7]:
        shutil.copy(tmp_path / "images" / NAMES[0], tmp_path / "images" / name)
    transforms(tmp_path / "transforms.json")
    with pytest.raises(
        ValueError, match=f"7 of {COUNT} photos with cameras have the same bytes .* {NAMES[1]}"
    ):
        loaded(tmp_path)


def test_two_estimates_of_one_camera_are_kept(tmp_path: Path) -> None:
    """They are copies, of which `pipeline.near_copies` leaves one out."""
    noise(tmp_path / "images")
    shutil.copy(tmp_path / "images" / NAMES[3], tmp_path / "images" / NAMES[9])
    of = frames()
    of[9]["transform_matrix"] = [row.copy() for row in of[3]["transform_matrix"]]
    of[9]["transform_matrix"][0][3] += 0.01
    transforms(tmp_path / "transforms.json", of)
    scene = loaded(tmp_path)
    assert (len(scene.views), scene.left_out, scene.warnings) == (COUNT, (), ())


def test_photos_of_one_colour_are_kept(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    shutil.copy(tmp_path / "images" / NAMES[3], tmp_path / "images" / NAMES[9])
    transforms(tmp_path / "transforms.json")
    check(loaded(tmp_path), ALL)

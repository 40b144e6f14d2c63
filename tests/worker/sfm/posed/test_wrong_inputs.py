"""Proves what readers without a test of their own make of files that are cut off, mirrored, or in other units.

Those of other programs are in test_programs.py, intrinsics of transforms.json and of COLMAP in test_intrinsics.py, and
conventions that only photos can tell apart in test_points.py.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.files.program_files import PROGRAMS, SIZE, record3d
from tests.support.posed_sets import COUNT, NAMES, frames, loaded, photos, transforms, viewmat

Change = Callable[[dict[str, Any]], None]


def of_polycam(folder: Path, change: Change | None = None) -> Path:
    photos(folder / "keyframes/images", [f"{k}.jpg" for k in range(COUNT)])
    (folder / "keyframes/cameras").mkdir()
    for k, frame in enumerate(frames()):
        rows = np.roll(np.array(frame["transform_matrix"])[:3], -1, axis=0)
        camera = {f"t_{i}{j}": rows[i, j] for i in range(3) for j in range(4)}
        camera |= {"fx": 60, "fy": 61, "cx": 32, "cy": 24, "width": 64, "height": 48}
        if change is not None:
            change(camera)
        (folder / f"keyframes/cameras/{k}.json").write_text(json.dumps(camera))
    return folder / "keyframes/cameras/5.json"


def of_record3d(folder: Path, change: Change | None = None) -> Path:
    photos(folder, [f"{k}.jpg" for k in range(COUNT)], size=SIZE)
    path = record3d(folder / "metadata.json", [viewmat(k) for k in range(COUNT)], each=False)
    document = json.loads(path.read_text())
    if change is not None:
        change(document)
    path.write_text(json.dumps(document))
    return path


def of_transforms(folder: Path, change: Change | None = None) -> Path:
    photos(folder / "images")
    transforms(folder / "transforms.json")
    return folder / "transforms.json"


def of_gaussian_splatting(folder: Path, change: Change | None = None) -> Path:
    photos(folder / "images", size=SIZE)
    path = PROGRAMS["3D Gaussian Splatting"].write(folder, [viewmat(k) for k in range(COUNT)], NAMES)
    document = json.loads(path.read_text())
    for camera in document:
        if change is not None:
            change(camera)
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize("make", [of_polycam, of_record3d, of_transforms])
def test_a_file_that_is_cut_off_is_named(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.9 * len(data))])
    with pytest.raises(ValueError, match=path.name):
        loaded(tmp_path)


def mirrored(camera: dict[str, Any]) -> None:
    for column in range(4):
        camera[f"t_0{column}"] *= -1.0


def in_other_units(camera: dict[str, Any]) -> None:
    """Parts of the sides in place of pixels."""
    camera.update({"fx": 60 / 64, "fy": 61 / 48, "cx": 0.5, "cy": 0.5})


def focal_in_parts(camera: dict[str, Any]) -> None:
    camera.update({"fx": 0.9, "fy": 1.2})


def long_quaternions(document: dict[str, Any]) -> None:
    document["poses"] = [[2.0 * value for value in pose[:4]] + pose[4:] for pose in document["poses"]]


def lens_in_parts(document: dict[str, Any]) -> None:
    document["K"] = [0.8, 0, 0, 0, 1.1, 0, 0.5, 0.5, 1]


@pytest.mark.parametrize(
    ("make", "change", "said"),
    [
        (of_polycam, mirrored, "the determinant -1"),
        (of_polycam, in_other_units, "intrinsics are in pixels"),
        (of_record3d, long_quaternions, "has the length 2, and not 1"),
        (of_record3d, lens_in_parts, "intrinsics are in pixels"),
        (of_gaussian_splatting, focal_in_parts, "intrinsics are in pixels"),
    ],
)
def test_other_axes_and_units_are_refused_with_both_readings(
    make: Callable[[Path, Change], Path], change: Change, said: str, tmp_path: Path
) -> None:
    make(tmp_path, change)
    with pytest.raises(ValueError, match=said):
        loaded(tmp_path)

"""Proves that intrinsics in other units than pixels and radians are refused with both readings, whatever file has them,
and that unusual ones in pixels are not.

Not proven here: focal lengths that are wrong by less; the warning of `points` is for them.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from splatmill_worker.sfm.posed.camera_models import IntrinsicsNotInPixels
from tests.support.posed_sets import NAMES, check, frames, image_lines, loaded, photos

ALL = {name: k for k, name in enumerate(NAMES)}
PIXELS = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24}


def capture(root: Path, **fields: Any) -> Path:
    photos(root / "images")
    (root / "transforms.json").write_text(json.dumps({**fields, "frames": frames()}))
    return root


@pytest.mark.parametrize(
    "fields",
    [
        {"fl_x": 60 / 64, "fl_y": 61 / 48, "cx": 0.5, "cy": 0.5},
        {"fl_x": 60 / 64, "fl_y": 61 / 48},
        {"cx": 0.5, "cy": 0.5},
        {"fl_x": 60 / 64, "fl_y": 61 / 48, "is_fisheye": True},
    ],
)
def test_parts_of_the_sides_are_refused(tmp_path: Path, fields: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="64 x 48 pixels; intrinsics are in pixels"):
        loaded(capture(tmp_path, **{**PIXELS, **fields}))


@pytest.mark.parametrize("degrees", [35.0, 56.1, 90.0, 400.0])
@pytest.mark.parametrize("field", ["camera_angle_x", "camera_angle_y"])
def test_an_angle_in_degrees_is_refused_with_the_radians(tmp_path: Path, degrees: float, field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is {degrees:g}; .* give {math.radians(degrees):.6g}"):
        loaded(capture(tmp_path, **{field: degrees}))


@pytest.mark.parametrize(
    "line",
    [
        "1 PINHOLE 64 48 0.94 1.27 0.5 0.5",
        "1 SIMPLE_RADIAL 64 48 0.94 0.5 0.5 0",
        "1 PINHOLE 64 48 60 61 0.5 0.5",
    ],
)
def test_a_colmap_model_is_checked_too(tmp_path: Path, line: str) -> None:
    photos(tmp_path / "images")
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.txt").write_text(f"{line}\n")
    (tmp_path / "sparse/0/images.txt").write_text("\n\n".join(image_lines(dict(enumerate(NAMES)))))
    with pytest.raises(IntrinsicsNotInPixels, match="Camera 1 of the COLMAP model"):
        loaded(tmp_path)


@pytest.mark.parametrize(
    "fields",
    [{"cx": 2.0, "cy": 1.5}, {"cx": -9, "cy": 0}, {"fl_x": 8, "fl_y": 8}, {"fl_x": 9000, "fl_y": 9000}],
)
def test_unusual_intrinsics_in_pixels_are_used(tmp_path: Path, fields: dict[str, Any]) -> None:
    check(loaded(capture(tmp_path, **{**PIXELS, **fields})), ALL)

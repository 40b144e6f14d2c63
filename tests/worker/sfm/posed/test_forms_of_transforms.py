"""Proves that transforms.json in the forms of several programs has exactly the cameras of the same COLMAP model.

The forms are after the programs' own converters and documentation. Luma AI describes none in public: its form is
that of other programs with a lens for each frame. Does not prove what files of their next versions will have.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill_worker.scene import Scene
from tests.support import posed_sets
from tests.support.posed_sets import COUNT, NAMES, frames, loaded

LENS = {"fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24, "w": 64, "h": 48}
Document = dict[str, Any]


def nerfstudio() -> Document:
    """With the transform that was applied already, and the model of the lens without distortion."""
    distortion = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    extra = {
        "applied_transform": [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        "orientation_override": "none",
    }
    numbered = [frame | {"colmap_im_id": k + 1} for k, frame in enumerate(frames())]
    return {**LENS, **distortion, "camera_model": "OPENCV", **extra, "frames": numbered}


def instant_ngp() -> Document:
    """With the angles of view beside the focal lengths, and members for its own volume."""
    angles = {
        f"camera_angle_{axis}": 2 * np.arctan(LENS[side] / (2 * LENS[f"fl_{axis}"]))
        for axis, side in ("xw", "yh")
    }
    volume = {"aabb_scale": 16, "scale": 0.33, "offset": [0.5, 0.5, 0.5], "is_fisheye": False}
    sharp = [{**frame, "file_path": f"./{frame['file_path']}", "sharpness": 30.5} for frame in frames()]
    return {**angles, **LENS, **volume, "k1": 0, "k2": 0, "k3": 0, "k4": 0, "p1": 0, "p2": 0, "frames": sharp}


def angles_alone() -> Document:
    """As of NeRF synthetic: no principal point, no size."""
    angles = {
        f"camera_angle_{axis}": 2 * np.arctan(LENS[side] / (2 * LENS[f"fl_{axis}"]))
        for axis, side in ("xw", "yh")
    }
    return {**angles, "frames": frames()}


def record3d() -> Document:
    """As NeRFCapture and the converters of Record3D: each frame has its lens, and names have no suffix."""
    own = [
        {
            "file_path": frame["file_path"].removesuffix(".jpg"),
            "transform_matrix": frame["transform_matrix"],
            "timestamp": 0.1 * k,
            **LENS,
        }
        for k, frame in enumerate(frames())
    ]
    return {"camera_model": "OPENCV", "integer_depth_scale": 1e-3, "frames": own}


def polycam() -> Document:
    """As polyform writes it: a lens for the document and one for each frame, which counts."""
    own = [{**frame, "file_path": f"./{frame['file_path']}", **LENS} for frame in frames()]
    return {**LENS, "fl_x": 59, "cx": 31, "frames": own}


def luma() -> Document:
    """A pinhole for each frame, 3 x 4 matrices, and members of no meaning here."""
    own = [
        {
            **frame,
            "transform_matrix": frame["transform_matrix"][:3],
            **LENS,
            "camera_label": f"{k}",
            "is_key": True,
        }
        for k, frame in enumerate(frames())
    ]
    return {"camera_model": "PINHOLE", "version": "0.2", "frames": own}


def other_names() -> Document:
    """fx, fy, width and height in place of fl_x, fl_y, w and h."""
    lens = {"fx": 60, "fy": 61, "cx": 32, "cy": 24, "width": 64, "height": 48}
    return {**lens, "frames": frames()}


VARIANTS = [nerfstudio, instant_ngp, angles_alone, record3d, polycam, luma, other_names]


def read(folder: Path, document: Document) -> Scene:
    posed_sets.photos(folder / "images")
    (folder / "transforms.json").write_text(json.dumps(document))
    return loaded(folder)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.__name__)
def test_a_variant_has_the_cameras_of_the_colmap_model(
    variant: Callable[[], Document], tmp_path: Path
) -> None:
    scene = read(tmp_path / "json", variant())
    posed_sets.photos(tmp_path / "colmap/images")
    posed_sets.model(tmp_path / "colmap/sparse/0")
    model = loaded(tmp_path / "colmap")
    assert [Path(view.name).name for view in scene.views] == [view.name for view in model.views] == NAMES
    for one, other in zip(scene.views, model.views, strict=True):
        np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-12)
        np.testing.assert_allclose(one.camera.K, other.camera.K, rtol=1e-12)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        assert one.lens is None
        assert other.lens is None
    assert scene.warnings == ()


@pytest.mark.parametrize(("key", "other"), [("fl_x", "fx"), ("fl_y", "fy"), ("w", "width"), ("h", "height")])
def test_two_fields_that_mean_the_same_and_differ_are_named(key: str, other: str, tmp_path: Path) -> None:
    document: Document = {**LENS, other: 2 * LENS[key], "frames": frames()}
    with pytest.raises(ValueError, match=f"{key} is {LENS[key]} and {other} is {2 * LENS[key]}"):
        read(tmp_path, document)


def test_a_lens_of_a_frame_counts_before_that_of_the_document(tmp_path: Path) -> None:
    document: Document = {**LENS, "frames": [frame | {"fl_x": 70 + k} for k, frame in enumerate(frames())]}
    assert [view.camera.fx for view in read(tmp_path, document).views] == [70 + k for k in range(COUNT)]

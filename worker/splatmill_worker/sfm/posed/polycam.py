"""The raw data of Polycam as a transforms document: a file with the camera of each photo, named like the photo.

The element t_ij of a file is that in row i and column j of the camera-to-world matrix, with OpenGL axes. Its world has
y up. The rows are exchanged so that z is up, as nerfstudio does with the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
"""The names of the intrinsics in a transforms document, and in Polycam's files. These have no distortion."""

DEPTH_UNIT = 1e-3
"""Metres of a level of the maps in keyframes/depth, whose photos have the same names."""

ROWS = (2, 0, 1)
"""The row of Polycam's matrix that each of x, y and z is."""


def document(paths: Sequence[Path], parsed: Callable[[Path], Any]) -> dict[str, Any]:
    """The transforms document of the files at `paths`; a frame is null where one of them has no pose.

    parsed: reads a JSON file. Raises what it raises.
    """
    return {
        "depth_unit_scale_factor": DEPTH_UNIT,
        "frames": [_frame(path, parsed(path)) for path in paths],
    }


def photo_folder(cameras: Path) -> str:
    """The folder of the photos that a folder of cameras belongs to, beside it."""
    return cameras.name.lower().replace("cameras", "images")


def check_photos(cameras: Path, photos: Iterable[str]) -> None:
    """Raise ValueError if no photo is in the folder that a folder of cameras belongs to, and others lie beside it.

    Corrected cameras are those of undistorted photos: with the others, each would be slightly wrong.
    """
    folder = photo_folder(cameras)
    parts = {part.lower() for name in photos for part in PurePosixPath(name).parts[:-1]}
    if folder not in parts and folder.removeprefix("corrected_") in parts:
        raise ValueError(
            f"The cameras in keyframes/{cameras.name} are those of the photos in keyframes/{folder}, which is missing. "
            f"Export the raw data again, or leave out {cameras.name}: the cameras in keyframes/cameras are then used."
        )


def _frame(path: Path, camera: Any) -> dict[str, Any]:
    frame: dict[str, Any] = {
        "file_path": f"{path.parent.parent.name}/{photo_folder(path.parent)}/{path.stem}"
    }
    if not isinstance(camera, dict):
        return frame
    rows = [[camera.get(f"t_{row}{column}") for column in range(4)] for row in ROWS]
    if all(value is not None for row in rows for value in row):
        frame["transform_matrix"] = rows
    return frame | {name: camera[own] for name, own in INTRINSICS.items() if own in camera}

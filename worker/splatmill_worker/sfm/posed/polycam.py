"""The raw data of Polycam as a transforms document: a file with the camera of each photo, named like the photo.

The element t_ij of a file is that in row i and column j of the camera-to-world matrix, with OpenGL axes. Its world has
y up. The rows are exchanged so that z is up, as nerfstudio does with the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
"""The names of the intrinsics in a transforms document, and in Polycam's files. These have no distortion."""

ROWS = (2, 0, 1)
"""The row of Polycam's matrix that each of x, y and z is."""


def document(paths: Sequence[Path], parsed: Callable[[Path], Any]) -> dict[str, Any]:
    """The transforms document of the files at `paths`; a frame is null where one of them has no pose.

    parsed: reads a JSON file. Raises what it raises.
    """
    return {"frames": [_frame(path, parsed(path)) for path in paths]}


def _frame(path: Path, camera: Any) -> dict[str, Any]:
    photos = path.parent.name.lower().replace("cameras", "images")
    frame: dict[str, Any] = {"file_path": f"{path.parent.parent.name}/{photos}/{path.stem}"}
    if not isinstance(camera, dict):
        return frame
    rows = [[camera.get(f"t_{row}{column}") for column in range(4)] for row in ROWS]
    if all(value is not None for row in rows for value in row):
        frame["transform_matrix"] = rows
    return frame | {name: camera[own] for name, own in INTRINSICS.items() if own in camera}

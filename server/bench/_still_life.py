"""A small capture of the built-in still life with its cameras, as the files of a nerfstudio data set."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from splatmill_worker import synthetic


def posed_capture(count: int, width: int, height: int) -> dict[str, bytes]:
    """Return `count` photos of width x height pixels and their transforms.json, by the path in a capture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cameras = synthetic.capture(folder, count, width, height)
        files: dict[str, bytes] = {f"images/{path.name}": path.read_bytes() for path in folder.glob("*.jpg")}
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # camera-to-world with OpenGL axes
    frames: list[dict[str, Any]] = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(camera.viewmat) @ flip).tolist()}
        for name, camera in cameras.items()
    ]
    one = next(iter(cameras.values()))
    lens = {"w": one.width, "h": one.height, "fl_x": one.fx, "fl_y": one.fy, "cx": one.cx, "cy": one.cy}
    files["poses/transforms.json"] = json.dumps(lens | {"frames": frames}).encode()
    return files

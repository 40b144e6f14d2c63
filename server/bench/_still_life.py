"""Small captures of the built-in still life, as the files that a client uploads, by their path in a capture."""

import io
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.film import Film

_RING = 96
"""Cameras of two turns around the still life of which neighbours are taken: 7.5 degrees apart, so that structure from
motion finds enough matches between photos of 160x120 pixels."""

_FIRST = _RING // 3

_FRAMES_PER_SECOND = 10


def posed_capture(count: int, width: int, height: int) -> dict[str, bytes]:
    """Return `count` photos of width x height pixels and their transforms.json, as a nerfstudio data set has them."""
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


def photos(count: int, width: int, height: int) -> dict[str, bytes]:
    """Return `count` photos without cameras, close enough to each other for structure from motion."""
    files = {}
    for number, rgb in enumerate(_neighbours(count, width, height), 1):
        content = io.BytesIO()
        Image.fromarray(rgb).save(content, "JPEG", quality=95)
        files[f"images/still_{number:02d}.jpg"] = content.getvalue()
    return files


def video(count: int, width: int, height: int) -> dict[str, bytes]:
    """Return a video of `count` frames, which are as close to each other as those of `photos`."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "still.mp4"
        with Film(path, width, height, _FRAMES_PER_SECOND) as film:
            for rgb in _neighbours(count, width, height):
                film.add(rgb)
        return {"images/still.mp4": path.read_bytes()}


def _neighbours(count: int, width: int, height: int) -> Iterator[np.ndarray]:
    scene = synthetic.still_life()
    for camera in synthetic.orbit(_RING, width, height)[_FIRST : _FIRST + count]:
        yield synthetic.photograph(scene, camera)[0]

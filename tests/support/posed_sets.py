"""Small data sets with given cameras: photos of one colour, COLMAP models as text, transforms.json; and their check."""

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatmill_worker.scene import Camera, Float, Scene
from splatmill_worker.sfm import posed

COUNT = 12
NAMES = [f"view {k:02}.jpg" for k in range(COUNT)]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def viewmat(k: int) -> Float:
    """The world-to-camera matrix of a camera turned by k tenths about its y axis, k units along x."""
    c, s = math.cos(0.1 * k), math.sin(0.1 * k)
    matrix = np.eye(4)
    matrix[:3] = [[c, 0.0, s, float(k)], [0.0, 1.0, 0.0, 0.5], [-s, 0.0, c, 2.0]]
    return matrix


def photos(folder: Path, names: list[str] = NAMES, size: tuple[int, int] = (64, 48)) -> None:
    for k, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, (20 * k, 255 - 20 * k, 99)).save(path)


def image_lines(names: dict[int, str]) -> list[str]:
    return [
        f"{k + 1} {math.cos(0.05 * k)!r} 0 {math.sin(0.05 * k)!r} 0 {k} 0.5 2 1 {name}"
        for k, name in names.items()
    ]


def model(
    folder: Path, names: dict[int, str] | None = None, change: Callable[[str], bytes] = str.encode
) -> None:
    """A COLMAP model as text, of which `change` writes each file."""
    folder.mkdir(parents=True)
    lines = image_lines(dict(enumerate(NAMES)) if names is None else names)
    (folder / "cameras.txt").write_bytes(change("# cameras\n1 PINHOLE 64 48 60 61 32 24\n"))
    (folder / "images.txt").write_bytes(change("# images\n" + "".join(f"{line}\n\n" for line in lines)))
    track = " ".join(line.split()[0] + " 0" for line in lines[:2])
    (folder / "points3D.txt").write_bytes(change(f"# points\n7 1 2 3 9 9 9 0.5 {track}\n"))


def frame_of(name: str, viewmat: Float, **fields: Any) -> dict[str, Any]:
    """The frame of a transforms.json for a world-to-camera matrix: from camera to world, with OpenGL axes."""
    matrix = np.linalg.inv(viewmat) @ FLIP
    return {"file_path": f"images/{name}", "transform_matrix": matrix.tolist(), **fields}


def document(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """The transforms.json of photos with these cameras, which have one lens."""
    one = next(iter(cameras.values()))
    lens = {"w": one.width, "h": one.height, "fl_x": one.fx, "fl_y": one.fy, "cx": one.cx, "cy": one.cy}
    return {**lens, "frames": [frame_of(name, camera.viewmat) for name, camera in cameras.items()]}


def frames(names: list[str] = NAMES) -> list[dict[str, Any]]:
    return [frame_of(name, viewmat(k)) for k, name in enumerate(names)]


def transforms(path: Path, of: list[Any] | None = None, change: Callable[[str], bytes] = str.encode) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lens = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24}
    path.write_bytes(change(json.dumps({**lens, "frames": of or frames()})))


def loaded(capture: Path) -> Scene:
    source = posed.find(capture)
    assert source is not None
    return source.load()


def check(scene: Scene, expected: dict[str, int]) -> None:
    """The views are those of the photos with these names, with the cameras of these numbers."""
    assert {view.name for view in scene.views} == set(expected)
    for view in scene.views:
        np.testing.assert_allclose(view.camera.viewmat, viewmat(expected[view.name]), atol=1e-12)
        assert view.image.is_file()


ALL = {name: k for k, name in enumerate(NAMES)}


def zip_of(folder: Path, target: Path, slash: str = "/", only: str = "*") -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob(only)):
            if path.is_file() and path != target:
                entry = zipfile.ZipInfo("x")
                entry.filename = path.relative_to(folder).as_posix().replace("/", slash)
                archive.writestr(entry, path.read_bytes())

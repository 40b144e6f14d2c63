"""Files with cameras as other programs write them, from world-to-camera matrices; and their projections.

Each function writes the file after the description of its format, and knows nothing of the reader.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
FLIP = np.diag([1.0, -1.0, -1.0])
SIZE = 640, 480

TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
SCALE, ORIGIN = 2.5, np.array([3.0, -7.0, 11.0])
"""The transform of Metashape's chunk."""


def _radial(r2: Float, *k: float) -> Float:
    return np.asarray(1.0 + sum(value * r2 ** (order + 1) for order, value in enumerate(k)))


METASHAPE = {
    "f": 512.0,
    "cx": 9.0,
    "cy": -6.0,
    "b1": 1.5,
    "k1": -0.11,
    "k2": 0.07,
    "k3": -0.02,
    "p1": 0.003,
    "p2": -0.0017,
}


def metashape_project(points: Float, value: dict[str, float] = METASHAPE) -> Float:
    """The appendix "Camera models" of Metashape's manual, for cameras of the type frame."""
    x, y = (points[:, axis] / points[:, 2] for axis in (0, 1))
    r2 = x * x + y * y
    radial = _radial(r2, *(value.get(f"k{order}", 0.0) for order in range(1, 5)))
    p1, p2 = value["p1"], value["p2"]
    x_, y_ = (
        x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y,
    )
    u = SIZE[0] * 0.5 + value["cx"] + x_ * value["f"] + x_ * value["b1"] + y_ * value.get("b2", 0.0)
    return np.stack([u, SIZE[1] * 0.5 + value["cy"] + y_ * value["f"]], axis=1)


def metashape(
    folder: Path,
    viewmats: Sequence[Float],
    names: Sequence[str],
    value: dict[str, float] = METASHAPE,
    kind: str = "frame",
) -> Path:
    lines = []
    for index, (viewmat, name) in enumerate(zip(viewmats, names, strict=True)):
        rotation, center = viewmat[:3, :3].T, -viewmat[:3, :3].T @ viewmat[:3, 3]
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = TURN.T @ rotation, TURN.T @ (center - ORIGIN) / SCALE
        lines.append(
            f'<camera id="{index}" sensor_id="0" label="{name.rpartition(".")[0]}"><transform>'
            + " ".join(map(repr, local.ravel().tolist()))
            + "</transform></camera>"
        )
    calibration = "".join(f"<{name}>{number!r}</{name}>" for name, number in value.items())
    path = folder / "cameras.xml"
    path.write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="a lens" type="{kind}"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/>
<calibration type="{kind}" class="initial"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/><f>1</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/>
{calibration}</calibration>
</sensor></sensors>
<components next_id="1"><component id="0" label="Component 1"/></components>
<cameras next_id="99">{"".join(lines)}
<camera id="98" sensor_id="0" label="not aligned"/></cameras>
<transform><rotation>{" ".join(map(repr, TURN.ravel().tolist()))}</rotation>
<translation>{" ".join(map(repr, ORIGIN.tolist()))}</translation><scale>{SCALE}</scale></transform>
</chunk></document>"""
    )
    return path


REALITY = {
    "f": 29.0,
    "px": 0.012,
    "py": -0.007,
    "k1": -0.12,
    "k2": 0.05,
    "k3": -0.01,
    "k4": 0.0,
    "t1": 0.002,
    "t2": -0.001,
}


def reality_project(points: Float) -> Float:
    """The page "XMP camera math" of RealityCapture: film coordinates over the longest side."""
    value, longest = REALITY, max(SIZE)
    x, y = (points[:, axis] / points[:, 2] for axis in (0, 1))
    r2 = x * x + y * y
    radial = _radial(r2, *(value[f"k{order}"] for order in range(1, 5)))
    x_ = x * radial + value["t1"] * (r2 + 2 * x * x) + 2 * value["t2"] * x * y
    y_ = y * radial + value["t2"] * (r2 + 2 * y * y) + 2 * value["t1"] * x * y
    u = (value["f"] / 36 * x_ + value["px"]) * longest + SIZE[0] / 2
    return np.stack([u, (value["f"] / 36 * y_ + value["py"]) * longest + SIZE[1] / 2], axis=1)


def reality_csv(folder: Path, viewmats: Sequence[Float], names: Sequence[str]) -> Path:
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for viewmat, name in zip(viewmats, names, strict=True):
        matrix = viewmat[:3, :3].T @ FLIP
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        heading = -math.atan2(-matrix[0, 1], matrix[1, 1])
        pitch, roll = math.asin(matrix[2, 1]), math.atan2(-matrix[2, 0], matrix[2, 2])
        angles = [math.degrees(angle) for angle in (heading, pitch, roll)]
        lines.append(",".join([name, *map(repr, [*center.tolist(), *angles, *REALITY.values()])]))
    path = folder / "registration.csv"
    path.write_text("\r\n".join(lines) + "\r\n", "utf-8-sig")
    return path


def reality_xmp(folder: Path, viewmats: Sequence[Float], names: Sequence[str]) -> Path:
    numbers = [REALITY[key] for key in ("k1", "k2", "k3", "k4", "t1", "t2")]
    path = folder
    for viewmat, name in zip(viewmats, names, strict=True):
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        path = folder / (name.rpartition(".")[0] + ".xmp")
        path.write_text(
            f'''<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute" xcr:DistortionModel="brown4t2"
       xcr:FocalLength35mm="{REALITY["f"]}" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{REALITY["px"]}"
       xcr:PrincipalPointV="{REALITY["py"]}" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>{" ".join(map(repr, viewmat[:3, :3].ravel().tolist()))}</xcr:Rotation>
      <xcr:Position>{" ".join(map(repr, center.tolist()))}</xcr:Position>
      <xcr:DistortionCoeficients>{" ".join(map(repr, numbers))}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>'''
        )
    return path


BUNDLER = 530.0, -0.08, 0.03


def bundler_project(points: Float) -> Float:
    """Bundler's manual: -z is ahead and y is up; pixels from the middle, y up."""
    own = points @ FLIP
    p = -own[:, :2] / own[:, 2:]
    f, k1, k2 = BUNDLER
    scaled = f * _radial((p * p).sum(axis=1), k1, k2)[:, None] * p
    return np.stack([SIZE[0] / 2 + scaled[:, 0], SIZE[1] / 2 - scaled[:, 1]], axis=1)


def bundler(folder: Path, viewmats: Sequence[Float], names: Sequence[str]) -> Path:
    lines = ["# Bundle file v0.3", f"{len(names) + 1} 2"]
    for viewmat in viewmats:
        rows = [BUNDLER, *(FLIP @ viewmat[:3, :3]).tolist(), (FLIP @ viewmat[:3, 3]).tolist()]
        lines += [" ".join(map(repr, row)) for row in rows]
    lines += ["0 0 0"] * 5
    lines += ["1.5 2.5 3.5", "10 20 30", "2 0 7 1.0 2.0 1 8 -3.0 4.0"] * 2
    (folder / "list.txt").write_text(
        "".join(f"images/{name} 0 {BUNDLER[0]}\n" for name in (*names, "unplaced.jpg"))
    )
    path = folder / "bundle.out"
    path.write_text("\n".join(lines) + "\n")
    return path


OPENSFM = {
    "projection_type": "brown", "width": 2 * SIZE[0], "height": 2 * SIZE[1],
    "focal_x": 0.83, "focal_y": 0.829, "c_x": 0.011, "c_y": -0.008,
    "k1": -0.1, "k2": 0.04, "k3": -0.006, "p1": 0.0012, "p2": -0.0021,
}  # fmt: skip


def opensfm_project(points: Float) -> Float:
    """The page "Geometric models" of OpenSfM, for the type brown; here for a photo of half the size."""
    value: dict[str, Any] = OPENSFM
    x, y = (points[:, axis] / points[:, 2] for axis in (0, 1))
    r2 = x * x + y * y
    radial = _radial(r2, value["k1"], value["k2"], value["k3"])
    x_ = x * radial + 2 * value["p1"] * x * y + value["p2"] * (r2 + 2 * x * x)
    y_ = y * radial + 2 * value["p2"] * x * y + value["p1"] * (r2 + 2 * y * y)
    u = (value["focal_x"] * x_ + value["c_x"]) * max(SIZE) + SIZE[0] / 2
    return np.stack([u, (value["focal_y"] * y_ + value["c_y"]) * max(SIZE) + SIZE[1] / 2], axis=1)


def opensfm(folder: Path, viewmats: Sequence[Float], names: Sequence[str]) -> Path:
    shots = {}
    for viewmat, name in zip(viewmats, names, strict=True):
        rotation = viewmat[:3, :3]
        angle = math.acos(min(1.0, (float(np.trace(rotation)) - 1) / 2))
        axis = np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        vector = axis * (0.5 if angle < 1e-9 else angle / (2 * math.sin(angle)))
        shots[name] = {"camera": "v2 a", "rotation": vector.tolist(), "translation": viewmat[:3, 3].tolist()}
    points = {"1": {"coordinates": [1.5, 2.5, 3.5], "color": [10, 20, 30]}}
    document = [
        {"cameras": {"v2 a": OPENSFM}, "shots": shots, "points": points},
        {"cameras": {}, "shots": {}},
    ]
    path = folder / "reconstruction.json"
    path.write_text(json.dumps(document))
    return path


def quaternion(rotation: Float) -> list[float]:
    """w, x, y, z of a rotation by less than half a turn."""
    w = 0.5 * math.sqrt(1.0 + float(np.trace(rotation)))
    skew = rotation - rotation.T
    return [w, *(np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (4.0 * w)).tolist()]


VISUALSFM = 530.0, -0.06


def visualsfm_project(points: Float) -> Float:
    """The manual of VisualSFM: m (1 + r |m|^2) is where a pinhole sees what the photo shows at m, over f."""
    f, r = VISUALSFM
    plain = points[:, :2] / points[:, 2:]
    shown = plain
    for _ in range(100):
        shown = plain / (1.0 + r * (shown * shown).sum(axis=1, keepdims=True))
    return np.asarray(np.array(SIZE) / 2 + f * shown)


def visualsfm(folder: Path, viewmats: Sequence[Float], names: Sequence[str], *, matrix: bool = False) -> Path:
    lines = ["NVM_V3_R9T" if matrix else "NVM_V3 ", "", str(len(names))]
    f, r = VISUALSFM
    for viewmat, name in zip(viewmats, names, strict=True):
        rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
        pose = (
            [*rotation.ravel().tolist(), *shift.tolist()]
            if matrix
            else [*quaternion(rotation), *(-rotation.T @ shift).tolist()]
        )
        shown = name.replace(" ", '"')
        lines.append(f"images/{shown}\t{' '.join(map(repr, [f, *pose, r, 0]))}")
    lines += ["", "2"] + ["1.5 2.5 3.5 10 20 30 2 0 7 1.0 2.0 1 8 -3.0 4.0"] * 2
    path = folder / "scene.nvm"
    path.write_text("\n".join([*lines, "", "0"]) + "\n")
    return path


GAUSSIAN_SPLATTING = 530.0, 534.0


def gaussian_splatting_project(points: Float) -> Float:
    """A pinhole with the principal point in the middle."""
    plain = points[:, :2] / points[:, 2:]
    return np.asarray(np.array(SIZE) / 2 + np.array(GAUSSIAN_SPLATTING) * plain)


def gaussian_splatting(folder: Path, viewmats: Sequence[Float], names: Sequence[str]) -> Path:
    """As `camera_to_JSON` of Inria's trainer writes them: for photos of twice the size, without their suffix."""
    cameras = []
    for index, (viewmat, name) in enumerate(zip(viewmats, names, strict=True)):
        to_world = np.linalg.inv(viewmat)
        cameras.append(
            {
                "id": index,
                "img_name": name.rpartition(".")[0],
                "width": 2 * SIZE[0],
                "height": 2 * SIZE[1],
                "position": to_world[:3, 3].tolist(),
                "rotation": to_world[:3, :3].tolist(),
                "fy": 2 * GAUSSIAN_SPLATTING[1],
                "fx": 2 * GAUSSIAN_SPLATTING[0],
            }
        )
    path = folder / "cameras.json"
    path.write_text(json.dumps(cameras))
    return path


RECORD3D = 520.0, 524.0, 311.0, 246.5


def record3d(path: Path, viewmats: Sequence[Float], *, each: bool) -> Path:
    """The metadata of photos called 0.jpg, 1.jpg and so on. each: whether every photo has a lens of its own."""
    fx, fy, cx, cy = RECORD3D
    poses = []
    for viewmat in viewmats:
        world = np.linalg.inv(viewmat).astype(np.float64)
        w, x, y, z = quaternion(world[:3, :3])
        # Times the quaternion i, which is FLIP.
        poses.append([w, z, -y, -x, *world[:3, 3].tolist()])
    lenses = [[fx, fy, cx, cy]] * len(poses) if each else []
    k = [1.0, 0, 0, 0, 1.0, 0, 1.0, 1.0, 1] if each else [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    document = {
        "w": SIZE[0],
        "h": SIZE[1],
        "K": k,
        "poses": poses,
        "perFrameIntrinsicCoeffs": lenses,
        "fps": 60,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


@dataclass(frozen=True)
class Program:
    """A function that writes a file of cameras and returns its path, and the projection to pixels of points [N,3]."""

    write: Callable[[Path, Sequence[Float], Sequence[str]], Path]
    project: Callable[[Float], Float]


PROGRAMS = {
    "Metashape": Program(metashape, metashape_project),
    "RealityScan, CSV": Program(reality_csv, reality_project),
    "RealityScan, XMP": Program(reality_xmp, reality_project),
    "Bundler": Program(bundler, bundler_project),
    "OpenSfM": Program(opensfm, opensfm_project),
    "VisualSFM": Program(visualsfm, visualsfm_project),
    "3D Gaussian Splatting": Program(gaussian_splatting, gaussian_splatting_project),
}

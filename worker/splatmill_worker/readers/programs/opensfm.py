"""Cameras and points of OpenSfM and OpenDroneMap: reconstruction.json.

https://opensfm.org/docs/geometry.html describes it. A shot has an angle-axis rotation and a translation from world to
camera, with OpenCV axes. Focal lengths and principal points are relative to the longest side; the latter begin in the
middle.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from splatmill_worker.readers.programs.shots import (
    BROWN,
    FISHEYE,
    MOST_SHOTS,
    Float,
    NoCameras,
    Shot,
    Shots,
    brown,
    number,
    pinhole_or,
    text_of,
)

Lens = tuple[str, tuple[float, float], tuple[float, float], tuple[float, ...], tuple[int, int]]


def read(paths: list[Path]) -> Shots:
    """The cameras of the reconstruction with the most shots. Raises NoCameras, and ValueError for a damaged file."""
    text = text_of(paths[0])
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is damaged or cut off: {error}") from error
    models = document if isinstance(document, list) else [document]
    models = [each for each in models if isinstance(each, dict) and isinstance(each.get("shots"), dict)]
    if not models or not all(isinstance(each.get("cameras"), dict) for each in models):
        raise NoCameras("it has no shots and cameras, as a reconstruction of OpenSfM has")
    model = max(models, key=lambda each: len(each["shots"]))
    shots = _shots(model)
    if len(models) > 1:
        shots.warnings.append(
            f"Of {len(models)} reconstructions of OpenSfM, the one with the most photos is used, "
            f"{len(model['shots'])}."
        )
    return shots


def _shots(model: dict[str, Any]) -> Shots:
    if len(model["shots"]) > MOST_SHOTS:
        raise ValueError(f"it has more than {MOST_SHOTS} shots")
    lenses: dict[str, Lens] = {}
    cameras = Shots([])
    instances = model.get("rig_instances") or {}
    rigid = model.get("rig_cameras") or {}
    for name, shot in model["shots"].items():
        key = shot.get("camera") if isinstance(shot, dict) else None
        if not isinstance(key, str) or not isinstance(model["cameras"].get(key), dict):
            raise ValueError(f"the shot {name[:80]!r} has the camera {str(key)[:80]!r}, which is missing")
        if key not in lenses:
            lenses[key] = _lens(key, model["cameras"][key])
        if "rotation" not in shot or "translation" not in shot:
            raise ValueError(f"the shot {name[:80]!r} has no rotation and translation")
        if _of_rig(shot, instances, rigid):
            cameras.left_out.append((name, "it is a part of a rig of OpenSfM, and those are not read"))
            continue
        try:
            rotation = _rotation(_three(shot["rotation"], "its rotation"))
            translation = np.array(_three(shot["translation"], "its translation"))
        except ValueError as error:
            cameras.faulty.append((name, str(error)))
            continue
        pose = tuple(np.hstack([rotation, translation[:, None]]).ravel().tolist())
        model_name, focal, offset, distortion, size = lenses[key]
        cameras.shots.append(Shot(name, pose, model_name, focal, offset, distortion, size, relative=True))
    points = [each for each in (model.get("points") or {}).values() if isinstance(each, dict)]
    cameras.points = np.array([_three(each.get("coordinates"), "a point") for each in points]).reshape(-1, 3)
    colors = [_three(each.get("color") or (128, 128, 128), "the colour of a point") for each in points]
    cameras.colors = np.clip(np.array(colors).reshape(-1, 3), 0, 255).astype(np.uint8)
    return cameras


def _of_rig(shot: dict[str, Any], instances: dict[str, Any], cameras: dict[str, Any]) -> bool:
    """Whether a shot is one of several of a rig; those of rigs of one camera have their own pose."""
    instance = instances.get(shot.get("rig_instance_id", "")) if isinstance(instances, dict) else None
    members = instance.get("rig_camera_ids") if isinstance(instance, dict) else None
    return bool(cameras) and isinstance(members, dict) and len(members) > 1 and "rotation" not in shot


def _three(value: Any, what: str) -> list[float]:
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise ValueError(f"{what[:80]} has other values than three numbers")
    return [number(each, what[:80]) for each in value]


def _rotation(vector: list[float]) -> Float:
    """The matrix of an angle-axis vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = np.array(vector) / angle if angle > 1e-15 else np.zeros(3)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Float = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix


def _lens(key: str, camera: dict[str, Any]) -> Lens:
    """The model, focal lengths, offset, distortion and size of a Shot."""

    def at(name: str, default: float | None = None) -> float:
        return number(camera.get(name, default), f"{name} of the camera {key[:80]!r}")

    width, height = int(at("width")), int(at("height"))
    if not (width > 0 and height > 0):
        raise ValueError(f"the camera {key[:80]!r} has {width} x {height} pixels")
    kind = str(camera.get("projection_type", "perspective")).lower()
    make = _LENSES.get(kind)
    if make is None:
        raise ValueError(
            f"the projection type of the camera {key[:80]!r} is {kind[:40]!r}; those that are read are "
            f"{', '.join(_LENSES)}"
        )
    plain = "focal" in camera
    focal = (at("focal"), at("focal")) if plain else (at("focal_x"), at("focal_y"))
    if not min(focal) > 0.0:
        raise ValueError(f"the focal length of the camera {key[:80]!r} is {min(focal)}; it must be positive")
    model, distortion = make(at, (0.5 + abs(at("c_x", 0.0))) * 2.0**0.5 / min(focal))
    return model, focal, (at("c_x", 0.0), at("c_y", 0.0)), distortion, (width, height)


At = Callable[..., float]


def _brown(at: At, reach: float) -> tuple[str, tuple[float, ...]]:
    # OpenSfM's p1 and p2 are OpenCV's.
    radial = [at(f"k{order}", 0.0) for order in range(1, 4)]
    return brown(radial, at("p2", 0.0), at("p1", 0.0), reach)


_LENSES: dict[str, Callable[[At, float], tuple[str, tuple[float, ...]]]] = {
    "perspective": lambda at, _: pinhole_or(BROWN, (at("k1", 0.0), at("k2", 0.0), 0.0, 0.0)),
    "simple_radial": lambda at, _: pinhole_or(BROWN, (at("k1", 0.0), 0.0, 0.0, 0.0)),
    "radial": lambda at, _: pinhole_or(BROWN, (at("k1", 0.0), at("k2", 0.0), 0.0, 0.0)),
    "brown": _brown,
    "fisheye": lambda at, _: (FISHEYE, (at("k1", 0.0), at("k2", 0.0), 0.0, 0.0)),
    "fisheye_opencv": lambda at, _: (FISHEYE, tuple(at(f"k{order}", 0.0) for order in range(1, 5))),
}
"""The lenses by OpenSfM's names of projections."""

"""Cameras of Metashape (and PhotoScan): the XML of File > Export > Export Cameras, in the format Agisoft XML.

A camera's `transform` is from the camera, with OpenCV axes, to the chunk or the component that it belongs to, whose own
transform leads to the world. The manual's appendix "Camera models" has the projection: with x = X / Z and r^2 = x^2 +
y^2, x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y, y' = y (...) + p2 (r^2 + 2 y^2) +
2 p1 x y; u = w / 2 + cx + x' f + x' b1 + y' b2, v = h / 2 + cy + y' f. p1 and p2 are OpenCV's p2 and p1. Of a fisheye
lens, x and y are scaled to the angle from the axis before that.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from splatmill_worker.readers.programs.shots import (
    FISHEYE,
    FISHEYE_TANGENTIAL,
    MOST_SHOTS,
    Float,
    NoCameras,
    Shot,
    Shots,
    brown,
    number,
    numbers,
    pose_of,
    rotation_of,
)
from splatmill_worker.readers.programs.xml import root_of

MOST_SKEW = 0.5
"""Pixels by which the skew b2 may move the corner of a photo; COLMAP's models have none, so it is left out."""

GEOCENTRIC = 1e5
"""Distance of the cameras from the origin from which it is moved to them: in a file of 32-bit numbers, a place on the
earth would be exact to half a metre."""


def read(paths: list[Path]) -> Shots:
    """The cameras of the chunk with the most. Raises NoCameras, and ValueError for a damaged file."""
    root = root_of(paths[0])
    chunks = [root] if root.tag == "chunk" else list(root.iter("chunk"))
    if root.tag not in ("document", "chunk") or not any(
        chunk.find("cameras") is not None for chunk in chunks
    ):
        raise NoCameras("it is no file of cameras of Metashape")
    chunk = max(chunks, key=lambda each: sum(1 for _ in each.iterfind(".//cameras//camera/transform")))
    shots = _shots(chunk)
    if len(chunks) > 1:
        shots.warnings.append(
            f"Of {len(chunks)} chunks of Metashape, {chunk.get('label') or 'one'!r} is used, which has the most "
            "cameras."
        )
    return shots


def _shots(chunk: ElementTree.Element) -> Shots:
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    own = _similarity(chunk.find("transform"))
    components = {
        part.get("id"): _similarity(part.find("transform")) for part in chunk.iterfind("components/component")
    }
    by_component: dict[str | None, list[tuple[str, Float, Float, ElementTree.Element]]] = {}
    left_out: list[tuple[str, str]] = []
    faulty: list[tuple[str, str]] = []
    for camera in chunk.iterfind("cameras//camera"):
        name = camera.get("label") or f"camera {camera.get('id')}"
        sensor = sensors.get(camera.get("sensor_id"))
        transform = camera.find("transform")
        if camera.get("master_id") is not None:
            left_out.append(
                (name, "it is a part of a rig in Metashape, and the cameras of rigs are not read")
            )
        elif transform is None or sensor is None:
            left_out.append((name, "Metashape has not aligned it"))
        elif len(left_out) + sum(map(len, by_component.values())) >= MOST_SHOTS:
            raise ValueError(f"it has more than {MOST_SHOTS} cameras")
        else:
            try:
                matrix = np.reshape(numbers(transform.text, 16, "its transform"), (4, 4))
                posed = name, rotation_of(matrix[:3, :3]), matrix[:3, 3], sensor
            except ValueError as error:
                faulty.append((name, str(error)))
                continue
            by_component.setdefault(camera.get("component_id"), []).append(posed)
    if not by_component:
        return Shots([], left_out, faulty)
    component = max(by_component, key=lambda key: len(by_component[key]))
    scale, turn, origin = components.get(component) or own or (1.0, np.eye(3), np.zeros(3))
    placed = by_component[component]
    centers = np.array([scale * turn @ center + origin for _, _, center, _ in placed])
    notes: list[str] = []
    middle = centers.mean(axis=0)
    if np.linalg.norm(middle) > GEOCENTRIC:
        centers = centers - middle
        notes.append(
            "The cameras of Metashape are far from the origin of their coordinates, which is moved to their mean: "
            + ", ".join(f"{value:.3f}" for value in middle)
            + "."
        )
    lenses = {id(sensor): _lens(sensor) for _, _, _, sensor in placed}
    shots = [
        Shot(name, pose_of((turn @ rotation).T, center), *lenses[id(sensor)])
        for (name, rotation, _, sensor), center in zip(placed, centers, strict=True)
    ]
    result = Shots(shots, left_out, faulty, notes)
    for other, cameras in by_component.items():
        if other != component:
            result.left_out += [(name, "it is in another component of Metashape") for name, *_ in cameras]
    skews = {f"{value:.2g}" for sensor in sensors.values() if (value := _skew(sensor)) > 0.01}
    if skews:
        result.warnings.append(
            f"The skew b2 of Metashape's cameras is left out: it moves the corners of photos by {max(skews)} pixels."
        )
    return result


def _similarity(element: ElementTree.Element | None) -> tuple[float, Float, Float] | None:
    """Scale, rotation and translation of a `transform`; None where it has none of them."""
    if element is None or element.find("rotation") is None:
        return None
    scale = element.findtext("scale")
    rotation = np.reshape(numbers(element.findtext("rotation"), 9, "rotation of the chunk"), (3, 3))
    translation = numbers(element.findtext("translation"), 3, "translation of the chunk")
    size = 1.0 if scale is None else number(scale, "scale of the chunk")
    if not size > 0.0:
        raise ValueError(f"the scale of the chunk is {size}; it must be positive")
    return size, rotation_of(rotation), np.array(translation)


def _calibration(sensor: ElementTree.Element) -> ElementTree.Element:
    """The adjusted calibration of a sensor, or else its initial one. Raises ValueError without any."""
    calibrations = sensor.findall("calibration")
    adjusted = [each for each in calibrations if each.get("class") == "adjusted"]
    if not calibrations:
        raise ValueError(f"the sensor {sensor.get('label')!r} has no calibration; align the photos first")
    return (adjusted or calibrations)[0]


def _values(calibration: ElementTree.Element) -> dict[str, float]:
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "fx", "fy", "skew")
    return {name: number(calibration.findtext(name) or 0.0, name) for name in names}


def _size(calibration: ElementTree.Element, sensor: ElementTree.Element) -> tuple[int, int]:
    for element in (calibration.find("resolution"), sensor.find("resolution")):
        if element is not None:
            width, height = (int(number(element.get(side), side)) for side in ("width", "height"))
            if width > 0 and height > 0:
                return width, height
    raise ValueError(f"the sensor {sensor.get('label')!r} has no resolution")


def _lens(
    sensor: ElementTree.Element,
) -> tuple[str, tuple[float, float], tuple[float, float], tuple[float, ...], tuple[int, int]]:
    """The model, focal lengths, offset, distortion and size of a Shot."""
    calibration = _calibration(sensor)
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise ValueError(
            f"the cameras of the sensor {sensor.get('label')!r} are of the type {kind!r}, which is not read; "
            "those of the types frame and fisheye are"
        )
    value, (width, height) = _values(calibration), _size(calibration, sensor)
    if calibration.find("fx") is not None:
        # PhotoScan before 1.2 has fx and fy, and cx and cy from the corner.
        raise ValueError("it is of PhotoScan before version 1.2; export the cameras with a newer version")
    if value["p3"] or value["p4"]:
        raise ValueError("its lens has the coefficients p3 and p4; align again without them")
    focal = value["f"] + value["b1"], value["f"]
    if not min(focal) > 0.0:
        raise ValueError(
            f"the focal length f is {value['f']}, with b1 {value['b1']}; both must be positive in sum"
        )
    if _skew(sensor) > MOST_SKEW:
        raise ValueError(
            f"its lens has the skew b2 = {value['b2']:.4g}, which moves the corners of photos by {_skew(sensor):.2g} "
            "pixels, and no camera model here has one; optimise the cameras in Metashape without b2"
        )
    radial = tuple(value[f"k{order}"] for order in range(1, 5))
    if kind == "fisheye":
        if value["p1"] or value["p2"]:
            distortion: tuple[float, ...] = (*radial[:2], value["p2"], value["p1"], *radial[2:], 0.0, 0.0)
            model = FISHEYE_TANGENTIAL
        else:
            model, distortion = FISHEYE, radial
    else:
        reach = math.hypot(0.5 * width + abs(value["cx"]), 0.5 * height + abs(value["cy"])) / min(focal)
        model, distortion = brown(radial, value["p1"], value["p2"], reach)
    return model, focal, (value["cx"], value["cy"]), distortion, (width, height)


def _skew(sensor: ElementTree.Element) -> float:
    """Pixels by which the skew moves the upper and lower edges of a photo."""
    if sensor.find("calibration") is None:
        return 0.0
    calibration = _calibration(sensor)
    value = _values(calibration)
    return abs(value["b2"]) * 0.5 * _size(calibration, sensor)[1] / max(value["f"], 1e-9)

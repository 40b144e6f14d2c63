"""COLMAP models of generated observations along motions of a camera, with an error of a third of a pixel."""

import math
from collections.abc import Callable

import numpy as np

from splatmill_worker.colmap import pycolmap

FOCAL, WIDTH, HEIGHT = 400.0, 480, 360
"""The true camera, in pixels."""

POINTS, OBSERVED = 300, 100
"""Points of the scene, and those that a photo observes at most where nothing else is asked for."""

Motion = Callable[[float], tuple[list[float], list[float]]]
"""Where the camera is, and which point it faces, at a time from 0 to 1."""


def circle(pitch: float) -> Motion:
    def at(time: float) -> tuple[list[float], list[float]]:
        angle = 2 * math.pi * time
        across, up = 4 * math.cos(pitch), 4 * math.sin(pitch)
        return [across * math.cos(angle), across * math.sin(angle), up], [0, 0, 0]

    return at


def ball(time: float) -> tuple[list[float], list[float]]:
    return circle(0.1 + 0.8 * (0.5 + 0.5 * math.sin(9 * time)))(time)


def line(time: float) -> tuple[list[float], list[float]]:
    return [-2 + 4 * time, -4, 0], [-2 + 4 * time, 0, 0]


def grid(time: float) -> tuple[list[float], list[float]]:
    row, column = divmod(round(35 * time), 6)
    place = [-1.0 + 0.4 * column, -1.0 + 0.4 * row]
    return [*place, 4.0], [*place, 0.0]


def look(eye: list[float], target: list[float]) -> np.ndarray:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 1, 0] if abs(forward[2]) > 0.99 else [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], axis=1)


def model_of(
    motion: Motion,
    focal: float,
    few: int = 0,
    count: int = 36,
    focals: tuple[float, ...] = (FOCAL,),
    observed: int = OBSERVED,
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> pycolmap.Reconstruction:
    """A model of photos along `motion` whose camera starts with `focal`; the `few` first have another such camera.

    focals: the true focal lengths, of photos in turn.
    observed: points that a photo observes at most.
    distortion: k1, k2, p1 and p2 of the true lens.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (POINTS, 3))
    model = pycolmap.Reconstruction()
    for number in (1, 2) if few else (1,):
        params = [focal, WIDTH / 2, HEIGHT / 2, 0.0]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params, camera_id=number
            )
        )
    tracks: dict[int, list[tuple[int, int]]] = {}
    for number in range(count):
        pose = look(*motion(number / (count - 1)))
        local = points @ pose[:, :3].T + pose[:, 3]
        true = focals[number % len(focals)]
        params = [true, true, WIDTH / 2, HEIGHT / 2, *distortion]
        lens = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params)
        pixels = lens.img_from_cam(local, False)
        pixels += rng.normal(0, 0.33, (POINTS, 2))
        inside = np.flatnonzero(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1) & (local[:, 2] > 0))
        keep = rng.permutation(inside)[:observed]
        image = pycolmap.Image(
            name=f"{number:06d}.png",
            keypoints=pixels[keep],
            camera_id=2 if number < few else 1,
            image_id=number + 1,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for place, point in enumerate(keep):
            tracks.setdefault(int(point), []).append((number + 1, place))
    for point, elements in tracks.items():
        if len(elements) >= 3:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
            model.add_point3D(points[point], track, np.zeros(3, np.uint8))
    return model

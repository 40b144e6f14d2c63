"""Proves that the last bundle adjustment estimates only the lens parameters that the motion of the camera determines.

The models are generated: points, cameras, and observations with an error of a third of a pixel, started from a wrong
focal length. Does not prove that photos of such motions can be matched.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.mapping.adjust import adjust_with_lenses

FOCAL, WIDTH, HEIGHT = 400.0, 480, 360
"""The true camera, in pixels."""

POINTS, OBSERVED = 300, 100
"""Points of the scene, and those that a photo observes at most."""

Path = Callable[[float], tuple[list[float], list[float]]]
"""Where the camera is, and which point it looks at, at a time from 0 to 1."""


def circle(pitch: float) -> Path:
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


def model_of(path: Path, focal: float, few: int = 0, count: int = 36) -> pycolmap.Reconstruction:
    """A model of photos along `path` whose camera starts with `focal`; the `few` first have another such camera."""
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
        pose = look(*path(number / (count - 1)))
        local = points @ pose[:, :3].T + pose[:, 3]
        pixels = (
            FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2] + rng.normal(0, 0.33, (POINTS, 2))
        )
        seen = np.flatnonzero(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1) & (local[:, 2] > 0))
        keep = rng.permutation(seen)[:OBSERVED]
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


@pytest.mark.parametrize(
    ("path", "tied", "assumed"),
    [(ball, False, False), (circle(0.0), True, False), (line, True, True), (grid, True, True)],
    ids=["ball", "level circle", "line", "grid"],
)
def test_only_determined_parameters_are_estimated(path: Path, tied: bool, assumed: bool) -> None:
    start = 1.15 * FOCAL
    adjusted = adjust_with_lenses(model_of(path, start), {1: start}, 1, lambda: False)
    camera = adjusted.model.cameras[1]
    assert (bool(adjusted.tied), bool(adjusted.assumed)) == (tied, assumed)
    assert camera.model.name == ("SIMPLE_RADIAL" if tied else "OPENCV")
    expected = start if assumed else FOCAL
    assert camera.focal_length_x == pytest.approx(expected, rel=1e-9 if assumed else 5e-3)
    assert camera.focal_length_y / camera.focal_length_x == pytest.approx(1, abs=2e-3)
    assert adjusted.model.compute_mean_reprojection_error() < 0.5


def test_an_initial_focal_length_is_restored_where_views_are_parallel() -> None:
    adjusted = adjust_with_lenses(model_of(grid, 1.3 * FOCAL), {1: FOCAL}, 1, lambda: False)
    assert adjusted.assumed == {1}
    assert adjusted.model.cameras[1].focal_length == pytest.approx(FOCAL)
    assert adjusted.model.compute_mean_reprojection_error() < 0.5


def test_a_camera_of_few_photos_keeps_the_simple_lens_beside_one_of_many() -> None:
    model = model_of(ball, FOCAL, few=4)
    initial = dict.fromkeys((1, 2), FOCAL)
    adjusted = adjust_with_lenses(model, initial, 1, lambda: False)
    lenses = {camera: lens.model.name for camera, lens in adjusted.model.cameras.items()}
    assert lenses == {1: "OPENCV", 2: "SIMPLE_RADIAL"}

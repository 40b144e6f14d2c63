"""Proves that the path of an orbit video fits the cameras of the photos, and that its cameras look at the target."""

import math
from typing import Any, cast

import numpy as np
import pytest

from splatmill.schema import CameraPath, CameraSpec, Keyframe, OrbitRequest
from splatmill_worker.splat import orbit


def ring(first: float, last: float, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras on an arc (degrees) of radius 3 at height 1 around (5, 0, 0), looking at it."""
    turns = np.radians(np.linspace(first, last, count))
    target = np.array([5.0, 0.0, 0.0])
    centers = target + np.stack([3 * np.cos(turns), 3 * np.sin(turns), np.ones(count)], axis=1)
    forwards = (target - centers) / np.linalg.norm(target - centers, axis=1, keepdims=True)
    rights = np.cross(forwards, [0.0, 0.0, 1.0])
    ups = np.cross(rights / np.linalg.norm(rights, axis=1, keepdims=True), forwards)
    return centers, forwards, ups


def test_the_orbit_circles_where_photos_were_taken_all_around() -> None:
    path = orbit.fit_path(*ring(0, 330))
    assert path.target == pytest.approx([5.0, 0.0, 0.0], abs=1e-6)
    assert path.radius == pytest.approx(3.0)
    assert path.height == pytest.approx(1.0)
    eyes = np.array([path.eye(share) for share in np.linspace(0, 1, 37)])
    assert eyes[0] == pytest.approx(eyes[-1])
    turned = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0] - 5.0))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2 * math.pi)


def test_the_orbit_stays_on_the_side_that_was_seen() -> None:
    path = orbit.fit_path(*ring(-40, 40))
    eyes = np.array([path.eye(share) for share in np.linspace(0, 1, 37)])
    azimuths = np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0] - 5.0))
    assert azimuths.min() == pytest.approx(-40, abs=1)
    assert azimuths.max() == pytest.approx(40, abs=1)


def test_orbit_cameras_look_at_the_target() -> None:
    request = OrbitRequest(seconds=0.5, fps=12, width=64, height=48)
    path = orbit.fit_path(*ring(0, 330))
    for camera in orbit.cameras_along(path, request, 50.0):
        rotation = camera.viewmat[:3, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        projection = camera.project(path.target[None])
        assert (*projection.columns, *projection.rows) == pytest.approx((32.0, 24.0), abs=1e-6)
        assert rotation[1] @ np.array([0.0, 0.0, 1.0]) < 0, "the picture's down must not be the world's up"


def test_the_cameras_of_a_video_follow_a_path() -> None:
    views = [
        Keyframe(
            camera_to_world=CameraSpec.looking_at(eye, (0, 0, 0), width=4, height=3).camera_to_world,
            fov_y_deg=fov,
        )
        for eye, fov in (((4, 0, 1), 40), ((0, 4, 0), 50), ((-4, 0, 1), 60))
    ]
    wish = {"seconds": 1, "fps": 11, "width": 64, "height": 48}
    for closed in (False, True):
        request = OrbitRequest.model_validate(
            wish | {"camera_path": CameraPath(keyframes=views, closed=closed)}
        )
        cameras = list(orbit.orbit_cameras(None, cast(Any, None), request))
        assert len(cameras) == request.frames == 11
        first = CameraSpec.looking_at((4, 0, 1), (0, 0, 0), width=64, height=48, fov_y_deg=40)
        assert cameras[0].viewmat == pytest.approx(np.array(first.viewmat()), abs=1e-9)
        assert cameras[0].fy == pytest.approx(first.pinhole()[1])
        eye = np.linalg.inv(cameras[-1].viewmat)[:3, 3]
        assert (np.linalg.norm(eye - np.array([-4, 0, 1])) < 1e-6) == (not closed)

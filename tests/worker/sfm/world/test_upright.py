"""Proves that down and the point that cameras look at are found from synthetic cameras with a known down: held level by
unsteady hands, some of them rolled, from above, almost one way; and that doubts are reported.

Not proven here: how steady hands are.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatmill_worker.sfm.world.upright import down_of, focus_of

Float = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def looking(yaw: Float, pitch: Float, roll: Float) -> Float:
    """World-to-camera rotations [n,3,3] in a world with y down, from angles in degrees; a pitch above 0 looks down."""
    rotations = []
    for a, b, c in np.radians(np.stack([yaw, pitch, roll], axis=1)):
        z = np.array([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
        x = np.array([math.cos(a), 0.0, -math.sin(a)])
        y = np.cross(z, x)
        rotations.append([math.cos(c) * x + math.sin(c) * y, math.cos(c) * y - math.sin(c) * x, z])
    return np.array(rotations)


def turned(rotations: Float) -> tuple[Float, Float]:
    """The rotations in a world that is turned at random, and down in it."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    return rotations @ turn.T, turn[:, 1]


def degrees(direction: Float, truth: Float) -> float:
    return math.degrees(math.acos(np.clip(direction @ truth, -1.0, 1.0)))


def unsteady(count: int, yaw: Float, pitch: float) -> Float:
    random = np.random.default_rng(count)
    return looking(yaw, pitch + random.normal(0, 8, count), random.normal(0, 3, count))


@pytest.mark.parametrize(("arc", "pitch"), [(360, 0), (360, 45), (360, -30), (120, 10)])
def test_photos_that_are_held_level_tell_down(arc: int, pitch: int) -> None:
    rotations, truth = turned(unsteady(40, np.linspace(0, arc, 40), pitch))
    down = down_of(rotations)
    assert degrees(down.direction, truth) < 3.0
    assert down.doubt is None
    assert down.level >= 36


def test_a_third_of_rolled_photos_does_not_count() -> None:
    rotations = unsteady(45, np.linspace(0, 360, 45), 20)
    rotations[::3] = rotations[::3][:, [1, 0, 2]] * [
        [1],
        [-1],
        [1],
    ]  # on their side, as without an EXIF orientation
    moved, truth = turned(rotations)
    down = down_of(moved)
    assert degrees(down.direction, truth) < 3.0
    assert 25 <= down.level <= 32
    assert down.doubt is None


def test_photos_from_above_are_taken_to_look_down() -> None:
    rotations, truth = turned(looking(np.linspace(0, 300, 20), np.full(20, 88.0), np.zeros(20)))
    down = down_of(rotations)
    assert degrees(down.direction, truth) < 3.0
    assert down.doubt is not None
    assert "straight down" in down.doubt


def test_photos_that_look_one_way_leave_a_doubt() -> None:
    rotations, truth = turned(unsteady(20, np.linspace(-4, 4, 20), 0))
    down = down_of(rotations)
    assert degrees(down.direction, truth) < 8.0
    assert down.doubt is not None
    assert "almost one way" in down.doubt


def test_a_camera_that_is_turned_all_ways_leaves_a_doubt() -> None:
    random = np.random.default_rng(1)
    rotations = looking(random.uniform(0, 360, 60), random.uniform(-60, 60, 60), random.uniform(0, 360, 60))
    doubt = down_of(rotations).doubt
    assert doubt is not None
    assert "are rolled" in doubt


def test_a_single_camera_is_upright_with_a_doubt() -> None:
    rotations, truth = turned(looking(np.zeros(1), np.zeros(1), np.zeros(1)))
    down = down_of(rotations)
    assert degrees(down.direction, truth) < 1e-3
    assert down.doubt is not None


def test_cameras_around_a_thing_look_at_it_though_some_look_away() -> None:
    random = np.random.default_rng(0)
    target = np.array([3.0, -1.0, 2.0])
    centers = target + random.normal(size=(40, 3)) * [4, 0.5, 4]
    axes = target + 0.1 * random.normal(size=(40, 3)) - centers
    axes[::5] = random.normal(size=(8, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    assert (
        np.linalg.norm(focus_of(centers, axes, np.zeros((0, 3))) - target) < 0.3
    )  # least squares is 1.2 away


@pytest.mark.parametrize("points", [np.array([[0.0, 0, 9], [1, 0, 10], [0, 1, 11]]), np.zeros((0, 3))])
def test_cameras_that_look_one_way_look_at_the_points_or_ahead(points: Float) -> None:
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    focus = focus_of(centers, np.tile([0.0, 0, 1], (3, 1)), points)
    np.testing.assert_allclose(focus, [0, 0, 10] if len(points) else [1, 0, 2], atol=1e-9)

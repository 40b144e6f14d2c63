"""Camera paths: the camera passes each view exactly, moves smoothly between them, and stays rigid.

Not proved here: what a video of a path shows (tests/worker/render_service/test_orbit.py).
"""

from __future__ import annotations

import json
import math
from itertools import pairwise

import pytest
from pydantic import ValidationError

from splatmill.schema import CameraPath, CameraSpec, Keyframe, OrbitRequest

EYES = ((4.0, 0.0, 1.0), (0.0, 4.0, 0.0), (-3.0, -1.0, 2.0), (1.0, -4.0, -1.0))


def keyframe(eye: tuple[float, float, float], fov: float = 50.0) -> Keyframe:
    camera = CameraSpec.looking_at(eye, (0, 0, 0), width=64, height=48)
    return Keyframe(camera_to_world=camera.camera_to_world, fov_y_deg=fov)


def distance(a: Keyframe, b: Keyframe) -> float:
    """Greatest difference of two matrices."""
    pairs = zip(a.camera_to_world, b.camera_to_world, strict=True)
    return max(abs(x - y) for r, s in pairs for x, y in zip(r, s, strict=True))


@pytest.mark.parametrize("closed", [False, True])
def test_the_camera_passes_each_view(closed: bool) -> None:
    views = [keyframe(eye, 40 + 10 * i) for i, eye in enumerate(EYES)]
    path = CameraPath(keyframes=views, closed=closed)
    spans = len(views) if closed else len(views) - 1
    for number, view in enumerate(views):
        there = path.at(number / spans)
        assert distance(there, view) < 1e-9
        assert there.fov_y_deg == pytest.approx(view.fov_y_deg)
    assert distance(path.at(1.0), views[0 if closed else -1]) < 1e-9


def test_it_neither_jumps_nor_stops_and_stays_rigid() -> None:
    path = CameraPath(keyframes=[keyframe(eye) for eye in EYES], closed=True)
    steps = 400
    shown = [path.at(i / steps) for i in range(steps + 1)]  # each is checked to be rigid when it is made
    moves = [distance(a, b) for a, b in pairwise(shown)]
    assert max(moves) < 12 * 4 / steps
    assert min(moves) > 0.5 * 4 / steps
    bends = [abs(a - b) for a, b in pairwise(moves)]
    assert max(bends) < 0.2 * max(moves), "speed changes gradually, at the views too"


def test_a_turn_over_half_a_circle_is_taken() -> None:
    ahead, behind = keyframe((4, 0, 0)), keyframe((-4, 0, 0))
    half = CameraPath(keyframes=[ahead, behind]).at(0.5)
    forward = [row[2] for row in half.camera_to_world]
    assert math.hypot(*forward) == pytest.approx(1)


def test_bad_paths_are_refused() -> None:
    view = json.loads(keyframe(EYES[0]).model_dump_json())
    skewed = view | {"camera_to_world": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    for keyframes in ([view], [view] * 101, [view, skewed], [view, view | {"fov_y_deg": 180}], [view, {}]):
        with pytest.raises(ValidationError):
            CameraPath.model_validate({"keyframes": keyframes})
    with pytest.raises(ValidationError, match="given twice"):
        OrbitRequest.model_validate({"fov_y_deg": 50, "camera_path": {"keyframes": [view, view]}})

"""Proves which Gaussians strokes hold: by hand-computed places, by a slow definition on random ones, and that an edit
leaves out what was selected.

That the page selects the same is proved in tests/browser/model/test_selection.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from splatmill.schema import CameraSpec, EditModel, Selection, Stroke
from splatmill.schema.resources.models.selections import MOST_POINTS, MOST_STROKES
from splatmill_worker.render_service.edit import kept
from splatmill_worker.render_service.selection import selected, within
from splatmill_worker.splat.formats import ply
from tests.support.ball import write_ply
from tests.support.page.strokes import FRONT, random_strokes

SQUARE = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]


def points(*places: tuple[float, float, float]) -> np.ndarray:
    return np.array(places, dtype=np.float32)


def stroke(**fields: object) -> Stroke:
    return Stroke.model_validate({"camera_to_world": FRONT, **fields})


def test_a_closed_line_holds_what_is_seen_inside_of_it() -> None:
    means = points((0, 0, 1), (0.4, -0.4, 1), (0.8, 0, 1), (0.8, 0, 2), (0, 0, -1), (0, 0, 50))
    assert sorted(within(means, stroke(points=SQUARE))) == [0, 1, 3, 5]
    assert sorted(within(means, stroke(points=SQUARE, far=2))) == [0, 1, 3]
    twice = [*SQUARE, *SQUARE]
    assert len(within(means, stroke(points=twice))) == 0, "an area that is circled twice is outside"


def test_a_brush_holds_what_is_near_its_line() -> None:
    means = points(
        (0, 0, 1), (1, 0.09, 1), (2.09, 0, 1), (2.11, 0, 1), (-0.09, 0, 1), (1, 0.36, 4), (0, 0, 0)
    )
    line = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    assert sorted(within(means, stroke(points=line, radius=0.1))) == [0, 1, 2, 4, 5]
    assert sorted(within(means, stroke(points=line[:1], radius=0.1))) == [0, 4]
    assert sorted(within(means, stroke(points=[line[0], line[0]], radius=0.1))) == [0, 4]


def slow(means: np.ndarray, one: Stroke) -> list[int]:
    """The same by the definition, one Gaussian after the other."""
    pose = np.array(one.camera_to_world)
    line = np.array(one.points)
    held = []
    for index, mean in enumerate(means.astype(float)):
        x, y, z = pose[:3, :3].T @ (mean - pose[:3, 3])
        if not 0 < z <= (one.far or np.inf):
            continue
        place = np.array([x, y]) / z
        if one.radius is None:
            a, b = line - place, np.roll(line, -1, axis=0) - place
            crosses = (a[:, 1] <= 0) != (b[:, 1] <= 0)
            at = a[crosses, 0] - a[crosses, 1] * (b - a)[crosses, 0] / (b - a)[crosses, 1]
            inside = int((at > 0).sum()) % 2 == 1
        else:
            a, b = line[:-1] if len(line) > 1 else line, line[1:] if len(line) > 1 else line
            d = b - a
            along = ((place - a) * d).sum(1) / np.maximum((d * d).sum(1), 1e-30)
            inside = bool(
                (np.linalg.norm(a + np.clip(along, 0, 1)[:, None] * d - place, axis=1) <= one.radius).any()
            )
        if inside:
            held.append(index)
    return held


def test_random_strokes_hold_what_the_definition_says() -> None:
    means, strokes = random_strokes(3, gaussians=300, strokes=12)
    for one in strokes:
        assert sorted(within(means, one).tolist()) == slow(means, one)
    assert any(0 < len(within(means, one)) < 300 for one in strokes)


def test_strokes_are_added_taken_out_and_inverted() -> None:
    means = points((0, 0, 1), (0.4, 0, 1), (3, 0, 1))
    whole, part = stroke(points=SQUARE), stroke(points=[(0.4, 0.0)], radius=0.05, subtract=True)
    assert selected(means, Selection(strokes=[whole, part])).tolist() == [True, False, False]
    assert selected(means, Selection(strokes=[part, whole])).tolist() == [True, True, False]
    inverted = Selection(strokes=[whole, part], inverted=True)
    assert selected(means, inverted).tolist() == [False, True, True]


def test_an_edit_leaves_out_the_selection(tmp_path: Path) -> None:
    write_ply(tmp_path / "model.ply")
    gaussians = ply.read(tmp_path / "model.ply").gaussians
    view = CameraSpec.looking_at((0, -4, 0), (0, 0, 0), width=64, height=64)
    half = Stroke(camera_to_world=view.opencv_to_world(), points=[(0, -2), (2, -2), (2, 2), (0, 2)])
    keep = kept(gaussians, EditModel(selection=Selection(strokes=[half])))
    assert 100 < int(keep.sum()) < 300
    assert (gaussians.means[keep][:, 0] <= 1e-6).all()
    both = kept(gaussians, EditModel(selection=Selection(strokes=[half]), max_size=1e-6))
    assert not bool(both.any())


def test_not_finite_centres_are_in_no_stroke() -> None:
    means = points((np.nan, 0, 1), (0, np.inf, 1), (0, 0, np.inf), (0, 0, 1))
    assert within(means, stroke(points=SQUARE)).tolist() == [3]


@pytest.mark.parametrize(
    "wrong",
    [
        {"points": SQUARE[:2]},
        {"points": []},
        {"points": [(0, 0)] * (MOST_POINTS + 1), "radius": 1},
        {"points": SQUARE, "radius": 0},
        {"points": SQUARE, "far": -1},
        {"points": [(float("nan"), 0)], "radius": 1},
        {"points": SQUARE, "camera_to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
    ],
)
def test_what_is_no_stroke_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        stroke(**wrong)


def test_a_selection_is_bounded() -> None:
    one = stroke(points=[(0, 0)], radius=1)
    with pytest.raises(ValidationError):
        Selection(strokes=[one] * (MOST_STROKES + 1))
    with pytest.raises(ValidationError):
        Selection(strokes=[])
    line = [(0.123456, -0.123456)] * MOST_POINTS
    longest = Selection(strokes=[stroke(points=line, radius=0.123456)] * MOST_STROKES)
    assert len(longest.model_dump_json()) < 1 << 20, "it fits in the body of a request"

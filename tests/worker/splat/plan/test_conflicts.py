"""Every two training options that a run would refuse together, whatever its photos, are refused before the upload, and
no others: each value of each option beside each value of each other, by the schema and by the worker.

Does not prove what the worker refuses for its photos, nor for the machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import splatmill.schema.options
from splatmill.schema import Backend, TrainOptions, describe_options
from splatmill.schema.conflicts import CONFLICT, CONFLICTS
from splatmill_worker.errors import Refusal
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.splat.start.given_model import GivenModel
from tests.support.plans.facts import changed

MODEL = GivenModel(700, 2, psnr=27.0, one_color=12.0, another=11.0)
MODELS = ("a" * 16, "m.spz", "m.sog", "m.compressed.ply", "m.ply")
POINTS = ("p.las", "p.laz", "p.e57", "p.pcd", "p.xyz", "p.pts")
TEXTS = {
    "start": (*MODELS, *POINTS),
    "scale": ("a.jpg b.jpg 2m",),
    "test_views": (("a.jpg", "b.jpg"),),
}
"""Values of the options that are neither numbers nor choices."""


def levels() -> list[tuple[str, Any]]:
    """Each option with each of its values, or with its ends where these are numbers."""
    rows: list[tuple[str, Any]] = []
    for option in describe_options():
        values = TEXTS.get(option.name) or option.choices or (option.minimum, option.maximum)
        rows += [(option.name, value) for value in values]
    return rows


PAIRS = [
    {one[0]: one[1], other[0]: other[1]} for one, other in combinations(levels(), 2) if one[0] != other[0]
]

IN_ONE_PIECE: dict[str, set[object]] = {
    "time_budget": {1, 7 * 86400},
    "within": {5, 7 * 86400},
    "start": {*MODELS, *POINTS},
    "progress_video": {"view", "orbit"},
    "time_lapse": {"on"},
}
"""What is for a training in one piece: the plan of a training knows nothing of tiles."""


def excluded(values: Mapping[str, Any]) -> set[str]:
    """The names of the options that the schema refuses for each other."""
    try:
        TrainOptions.model_validate(values)
    except ValidationError as error:
        return {str(entry["loc"][0]) for entry in error.errors() if entry["type"] == CONFLICT}
    return set()


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splatmill.schema.options, "check_conflicts", lambda options: None)


def refused_by_plan(values: Mapping[str, Any]) -> bool:
    """Whether no plan can be made of these options, of photos for which one can be made of each alone."""
    options = TrainOptions.model_validate(values)
    if "tiles" in values:
        return any(value in IN_ONE_PIECE.get(name, ()) for name, value in values.items())
    facts = changed(
        sky_share=0.3, seconds_left=options.within, start=MODEL if options.start in MODELS[:-1] else None
    )
    named: dict[Backend, Kernels] = {Backend.reference: "reference", Backend.gpu: "gpu"}
    kernels = named.get(options.backend, "cpu")
    try:
        decide(facts, options, kernels)
    except ValueError:
        return True
    return False


@pytest.mark.usefixtures("unchecked")
def test_no_option_is_refused_alone() -> None:
    for name, value in levels():
        assert not refused_by_plan({name: value}), (name, value)


@pytest.mark.slow
def test_the_pairs_that_have_no_plan_are_refused_by_the_schema_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = {number: excluded(pair) for number, pair in enumerate(PAIRS)}
    monkeypatch.setattr(splatmill.schema.options, "check_conflicts", lambda options: None)
    conflicts = set()
    for number, pair in enumerate(PAIRS):
        assert refused[number] == (set(pair) if refused_by_plan(pair) else set()), pair
        conflicts |= {frozenset(refused[number])}
    assert conflicts - {frozenset()} == {frozenset(each.names) for each in CONFLICTS}


@pytest.mark.parametrize("start", POINTS)
def test_a_scale_is_refused_with_cameras_whatever_the_start(start: str, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    (capture / "images").mkdir(parents=True)
    (capture / "poses").mkdir()
    (capture / "poses" / start).touch()
    (capture / "poses" / "transforms.json").write_text('{"frames": []}')
    options = TrainOptions.model_validate({"scale": "a.jpg b.jpg 2m", "start": start})
    with pytest.raises(Refusal) as refused:
        posed_scene(capture, tmp_path / "work", options, lambda *_: None, lambda: False)
    assert refused.value.code == "option_out_of_range"


@pytest.mark.parametrize("conflict", CONFLICTS, ids=lambda conflict: "-".join(conflict.names))
def test_a_reason_names_both_options_or_what_they_are_for(conflict: Any) -> None:
    for name in conflict.names:
        assert name in conflict.reason

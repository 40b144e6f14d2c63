"""Proves that a stored plan is read back for the same options only, and that one of another version is not.

Does not prove that the pipeline resumes with it; tests/worker/pipeline/test_job.py does.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from splatmill.schema import Switch, TrainOptions
from splatmill_worker.splat.plan.plan_file import read_plan, write_plan
from tests.support.plans.facts import planned


def test_a_plan_is_read_back_for_the_options_it_was_made_for(tmp_path: Path) -> None:
    path, options = tmp_path / "plan.json", TrainOptions(steps=600)
    assert read_plan(path, options) is None
    plan = planned(steps=600)
    write_plan(path, options, plan)
    assert read_plan(path, options) == plan
    assert read_plan(path, TrainOptions(steps=601)) is None


def test_a_plan_of_another_version_is_not_read(tmp_path: Path) -> None:
    path, options = tmp_path / "plan.json", TrainOptions()
    write_plan(path, options, planned())
    stored = json.loads(path.read_text())
    stored["plan"]["forgotten"] = True
    path.write_text(json.dumps(stored))
    assert read_plan(path, options) is None
    del stored["plan"]["forgotten"], stored["plan"]["schedule"]["budget"]
    path.write_text(json.dumps(stored))
    assert read_plan(path, options) is None


def rewritten(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_an_option_that_was_added_or_removed_since_then_keeps_the_plan(tmp_path: Path) -> None:
    path, options = tmp_path / "plan.json", TrainOptions(steps=600)
    write_plan(path, options, planned(steps=600))
    stored = json.loads(path.read_text())
    assert stored["format"] == 1
    earlier = {name: value for name, value in stored["options"].items() if name != "gaps"} | {"removed": 7}
    rewritten(path, options=earlier)
    assert read_plan(path, options) is not None
    assert read_plan(path, TrainOptions(steps=600, gaps=Switch.off)) is None


@pytest.mark.parametrize("damage", ["", "{", "[]", "null", '{"options": 3, "plan": {}}', '{"options": {}}'])
def test_a_damaged_plan_is_made_anew_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    path = tmp_path / "plan.json"
    path.write_text(damage)
    assert read_plan(path, TrainOptions()) is None
    assert "The stored plan cannot be used" in caplog.text


def test_a_plan_of_a_later_format_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "plan.json"
    write_plan(path, TrainOptions(), planned())
    rewritten(path, format=2)
    assert read_plan(path, TrainOptions()) is None
    assert "it has format 2, and this version reads 1" in caplog.text

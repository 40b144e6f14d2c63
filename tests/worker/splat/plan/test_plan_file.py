"""Proves that a stored plan is read back for the same options only, and that one of another version is not.

Does not prove that the pipeline resumes with it; tests/worker/test_pipeline.py does.
"""

from __future__ import annotations

import json
from pathlib import Path

from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.plan_file import read_plan, write_plan
from tests.support.facts import planned


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

"""The list of mutations fits the kernels as they are, and its table says that every one was caught.

Not proven here: that the proofs catch them; `worker/mutations/run.py` does that, in its own time.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.support.paths import ROOT

FOLDER = ROOT / "worker" / "mutations"
KERNELS = ROOT / "worker" / "splatmill_worker" / "kernels"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"mutations_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


lists = load("mutants")


@pytest.mark.parametrize("mutant", [*lists.MUTANTS, *lists.NEXT], ids=lambda m: m.name)
def test_it_changes_one_place(mutant: Any) -> None:
    source = Path(KERNELS, mutant.file).read_text()
    assert source.count(mutant.before) == 1
    assert mutant.before != mutant.after


def test_each_was_tried_and_caught() -> None:
    rows = [json.loads(line) for line in (FOLDER / "mutations.jsonl").read_text().splitlines()]
    caught = [row["mutant"] for row in rows if row["caught_by"]]
    assert caught == [mutant.name for mutant in lists.MUTANTS]
    assert len(caught) >= 30

"""The list of mutations fits the kernels as they are, and what was tried was caught by the proofs.

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

TRIED = 35
"""How many have to be in the table as caught, so that rows are not lost."""


@pytest.mark.parametrize("mutant", [*lists.MUTANTS, *lists.NEXT], ids=lambda m: m.name)
def test_it_changes_one_place(mutant: Any) -> None:
    source = Path(KERNELS, mutant.file).read_text()
    assert source.count(mutant.before) == 1
    assert mutant.before != mutant.after


def test_what_was_tried_was_caught() -> None:
    rows = [json.loads(line) for line in (FOLDER / "mutations.jsonl").read_text().splitlines()]
    caught = {(row["file"], row["mutant"]): bool(row["caught_by"]) for row in rows}
    assert len(caught) == len(rows)
    listed = [(mutant.file, mutant.name) for mutant in lists.MUTANTS]
    assert len(set(listed)) == len(listed)
    assert [name for name in listed if not caught.get(name, True)] == []
    assert sum(caught.get(name, False) for name in listed) >= TRIED


def test_the_table_is_that_of_the_rows() -> None:
    rows = [json.loads(line) for line in (FOLDER / "mutations.jsonl").read_text().splitlines()]
    table = (FOLDER / "mutations.md").read_text()
    for row in rows:
        by = f"`{row['caught_by']}`" if row["caught_by"] else "**nothing**"
        assert f"| {row['mutant']} | {row['file']} | {by} |" in table
    assert table.count("not tried |") == len(lists.MUTANTS) + len(lists.NEXT) - len(rows)


def test_every_file_has_a_mutant_or_a_reason() -> None:
    files = {
        str(path.relative_to(KERNELS))
        for backend in ("cpu", "gpu", "reference")
        for path in (KERNELS / backend).iterdir()
        if path.suffix in (".cpp", ".hpp", ".py")
    }
    mutated = {mutant.file for mutant in lists.MUTANTS}
    assert not mutated & set(lists.WITHOUT)
    assert files == mutated | set(lists.WITHOUT)

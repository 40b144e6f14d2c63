"""How long what is left will take, from rows that are there."""

from __future__ import annotations

from collections.abc import Iterable

from _rows import Row

from _train.rows import Run, failed

START = 4.0
"""Seconds that a process needs to load torch and COLMAP."""

AROUND = 12.0
"""Seconds of loading, evaluation and reports around a training of some forty small photos."""

PER_STEP = 0.012


def seconds_left(runs: Iterable[Run], rows: list[Row]) -> float:
    """Wall seconds for all of `runs`."""
    return sum(expected(run, rows) for run in runs)


def expected(run: Run, rows: list[Row]) -> float:
    """Wall seconds of one run: as long as its like took last time, else a guess from its budget."""
    for row in reversed(rows):
        if row["kind"] == "run" and not failed(row) and (row["scene"], row["budget"]) == _like(run):
            return START + float(row["wall_seconds"])
    if run.budget.steps is not None:
        return START + AROUND + PER_STEP * run.budget.steps
    assert run.budget.seconds is not None
    return START + AROUND + run.budget.seconds


def _like(run: Run) -> tuple[str, str]:
    return run.scene.name, run.budget.name

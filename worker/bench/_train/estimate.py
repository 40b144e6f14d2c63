"""How long what is left will take, from rows that are there."""

from __future__ import annotations

import statistics
from collections.abc import Iterable

from _rows import Row

from _train.rows import BenchRun, failed

START = 4.0
"""Seconds that a new process takes to load torch and COLMAP."""

AROUND = 12.0
"""Seconds of loading, evaluation and reports for a training on about forty small photos."""

PER_STEP = 0.012


def seconds_left(runs: Iterable[BenchRun], rows: list[Row]) -> float:
    """Wall seconds for all of `runs`."""
    return sum(expected(run, rows) for run in runs)


def expected(run: BenchRun, rows: list[Row]) -> float:
    """Expected wall seconds of a run: the median of like runs, else an estimate from its budget."""
    like = (run.scene.name, run.budget.name)
    known = [row for row in rows if row["kind"] == "run" and not failed(row)]
    times = [row["wall_seconds"] for row in known if (row["scene"], row["budget"]) == like]
    if times:
        return START + float(statistics.median(times))
    if run.budget.steps is not None:
        return START + AROUND + PER_STEP * run.budget.steps
    assert run.budget.seconds is not None
    return START + AROUND + run.budget.seconds

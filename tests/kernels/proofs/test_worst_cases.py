"""The worst inputs that `bench worst` has found stay as good as they were measured, on every build.

The inputs, and the ratio of error to conditioning that each engine had on them, are rows of
worker/bench/results/worst.jsonl. That there are no worse ones is not proven: that is a search.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import pytest
from _studies.stability.conditioning import Problem
from _studies.stability.engines import CHAIN, engines
from _studies.stability.search import posed, ratios

pytestmark = pytest.mark.slow

bench: Any = importlib.import_module("worst")

PINS = {f"{row['kind']}, {row['engine']}: {row['quantity']}": row for row in bench.pins()}
RUNNING = engines()

MARGIN = 3.0
"""Over the largest ratio that any build had on an input: another build rounds otherwise, and the unit, from DRAWS
changes of the input, is known to about a quarter."""

DRAWS = 16


@cache
def problem(name: str) -> Problem:
    return posed(bench.scene_of(PINS[name]), DRAWS)


@pytest.mark.parametrize("engine", bench.COMPARED)
@pytest.mark.parametrize("name", PINS)
def test_a_worst_input_is_no_worse_than_measured(name: str, engine: str) -> None:
    row = PINS[name]
    # The op chain has another arithmetic, with a ratio of its own; the builds of the fused step share theirs.
    alike = [x for other, x in row["every"].items() if (other == CHAIN) == (engine == CHAIN)]
    ratio = ratios(problem(name), RUNNING[engine])[row["quantity"]].explained
    assert ratio <= MARGIN * max(*alike, 1.0)

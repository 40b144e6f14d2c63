"""Changed files and headers end each parser with a result or a problem that has a name, and never take much memory.

Each parser gets a few inputs, the same ones every time; `splatmill bench fuzz` gives it new ones for ten minutes. Not
proven: that what a parser makes of a changed file is what its author meant.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator

import pytest

from tests.support.hostile.bench import Bench, bench
from tests.support.hostile.parsers import PARSERS

pytestmark = pytest.mark.slow

FEW = 12
"""Inputs of each parser."""

MEMORY = 1 << 30
"""Bytes by which this process may grow over all inputs of a parser; the decoders have limits of their own."""


@pytest.fixture(scope="module")
def parts() -> Iterator[Bench]:
    with bench() as started:
        yield started


@pytest.mark.parametrize("name", PARSERS)
def test_changed_files_end_with_a_result_or_a_named_problem(parts: Bench, name: str) -> None:
    parser = PARSERS[name]
    assert parser.give(parts, parser.valid())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    parser.try_changed(lambda data: parser.give(parts, data), FEW, 0)
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MEMORY

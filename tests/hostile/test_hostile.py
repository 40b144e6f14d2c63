"""Proves the answer that each hostile input of the list gets from the real server and the real worker.

Does not prove that the list is complete.
"""

from collections.abc import Iterator

import pytest

from tests.support.hostile.bench import Bench, bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.table import HOSTILE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def parts() -> Iterator[Bench]:
    with bench() as started:
        yield started


@pytest.mark.parametrize("entry", HOSTILE, ids=lambda entry: f"{entry.area}: {entry.what}")
def test_each_input_gets_its_answer(parts: Bench, entry: Hostile) -> None:
    answer = entry.give(parts)
    assert answer.kind.startswith(entry.kind), answer
    assert entry.said in answer.said, answer
    assert parts.request("GET /readyz").kind == "200", "the server is as well as before"


def test_there_are_at_least_forty_each_named_once() -> None:
    assert len(HOSTILE) >= 40
    assert len({(entry.area, entry.what) for entry in HOSTILE}) == len(HOSTILE)

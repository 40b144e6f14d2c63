"""`bench fuzz`: a parser is given inputs in its own process, and one that dies is a fault.

Not proved here: minutes of inputs (server/bench/fuzz.md has them); tests/hostile gives each parser a few.
"""

import fuzz
import pytest

pytestmark = pytest.mark.slow


def test_a_parser_is_given_inputs_and_its_outcomes_are_counted() -> None:
    row = fuzz.fuzzed("Last-Event-ID", 0.1, 1)
    assert row["fault"] == ""
    assert row["inputs"] >= 200
    assert sum(row["outcomes"].values()) == row["inputs"]
    origin = {"machine": "one", "versions": {"python": "3"}, "commit": "abc"}
    page = fuzz.STUDY.page([row | origin])
    assert f"| Last-Event-ID | 0 | {row['inputs']} |" in page
    assert page.count("| none |") == 1


def test_a_process_that_dies_is_a_fault() -> None:
    row = fuzz.fuzzed("no such parser", 0.1, 1)
    assert row["fault"].startswith("it ended with status 1")
    assert "KeyError: 'no such parser'" in row["fault"]

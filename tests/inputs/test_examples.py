"""Each small input as people have them gets the answer of its kind; docs/inputs.md has the same answers.

Does not prove what a training makes of them.
"""

from __future__ import annotations

import pytest
from docs.generate import inputs

from tests.support.inputs.example import Example, answer
from tests.support.inputs.table import EXAMPLES
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.what)
def test_an_input_gets_its_answer(example: Example) -> None:
    reply = answer(example.make)
    assert reply.kind == example.kind, reply.said


def test_the_page_of_inputs_is_that_of_the_program() -> None:
    assert (ROOT / "docs/inputs.md").read_text() == inputs.page(), "run: make generated"

"""The list of hostile inputs, each with the answer that the real server or worker gives while the page is made."""

from collections.abc import Callable

from docs.generate.markdown import table

from tests.support.hostile.bench import Answer, bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.table import HOSTILE

INTRODUCTION = f"""# Hostile inputs

What the service answers to {len(HOSTILE)} requests and files as an attacker, or bad luck, makes them. This page is made
by giving each of them to the server and to the worker; `tests/hostile` does the same, and fails when an answer differs.

An answer with a number is the HTTP status of a request, with the code of its [problem document](errors.md). The others
are what the worker does with an uploaded file: it *uses* it, *leaves it out*, with the reason in the job's log and
report, or the job *fails* with a code. `SECURITY.md` says against whom the service defends itself, and against whom it
does not.
"""


def page() -> str:
    """The page of hostile inputs."""
    with bench() as real:
        return _page(lambda entry: entry.give(real))


def expected_page() -> str:
    """The same with the kind and the part of each answer that the list expects; nothing is given to the program."""
    return _page(lambda entry: Answer(entry.kind, entry.said))


def _page(answer: Callable[[Hostile], Answer]) -> str:
    parts = [INTRODUCTION]
    for area in dict.fromkeys(entry.area for entry in HOSTILE):
        rows = [[entry.what, _shown(answer(entry))] for entry in HOSTILE if entry.area == area]
        parts += [f"## {area}\n", table(["input", "answer"], rows)]
    return "\n".join(parts)


def _shown(answer: Answer) -> str:
    said = "".join(char if char.isprintable() else "?" for char in answer.said[:300]).replace("`", "'")
    return f"{answer.kind}: {said}" if said else answer.kind

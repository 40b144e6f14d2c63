"""Proves that the lint of words reports a planted turn and a planted name, and nothing in the repository.

Does not prove that a sentence is plain.
"""

import pytest

from tests.support.words import NAMES, TURNS, main, problems


def test_the_repository_has_none(capsys):
    assert main() == 0, capsys.readouterr().out


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("name", ["docs/page.md", "server/page.html", "client/module.py", "server/page.js"])
def test_a_planted_turn_is_named_with_its_line(name: str, turn: str):
    text = f'"""One.\n\nThe server {turn.capitalize()} one."""\n'
    assert list(problems(name, text)) == [f"{name}:3: the turn {turn.capitalize()!r}"]


@pytest.mark.parametrize("comment", ["# a\n# b that\n# which c", "// a\n// b that\n// which c"])
def test_a_turn_goes_over_the_end_of_a_line(comment: str):
    [line] = problems("client/module.txt", comment)
    assert line.startswith("client/module.txt:2: ")


def test_words_that_hold_a_turn_are_none_of_it():
    assert not list(problems("docs/page.md", "Retells, foretells and heartily; what is therein; goes only."))


@pytest.mark.parametrize("name", sorted(NAMES))
@pytest.mark.parametrize(
    "code",
    [
        "{} = 1",
        "def f({}): ...",
        "def {}(): ...",
        "self.{} = 1",
        "for _{} in (): ...",
        "import os as {}",
        "with f() as {}: ...",
        "class {}: ...",
    ],
)
def test_a_planted_name_is_found_in_python(code: str, name: str):
    assert list(problems("client/module.py", code.format(name))) != []


@pytest.mark.parametrize("folder", [".ci", "docs", "server/web", "tests", "worker/bench"])
def test_a_planted_name_is_found_in_every_folder_and_in_capitals(folder: str):
    for name in ("FOUND", "_Seen"):
        assert list(problems(f"{folder}/module.py", f"{name} = 1")) != []


def test_a_planted_name_is_found_in_javascript():
    [line] = problems("page.js", "const x = 1;\nconst found = 2;")
    assert line == "page.js:2: the name 'found'"


def test_the_use_of_a_name_of_others_is_no_fault():
    assert not list(problems("client/module.py", "x = match.found\nf(wanted=1)\n'found'"))

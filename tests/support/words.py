"""The lint of words: turns of phrase and names that this project does not use. `python -m tests.support.words` runs it.

Each turn has a plainer form: "continues" for a program that resumes, the verb itself ("returns", "lists", "names") for
one that reports, a noun for a pronoun. A past participle is no name for a value: `match`, `visible`, `requested` or the
noun of the field is.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.support.paths import ROOT

TURNS = ("by heart", "that which", "tells", "looks at", "is said", "goes on", "what is there")
NAMES = frozenset({"found", "seen", "took", "given", "wanted"})

SUFFIXES = frozenset({".py", ".md", ".js", ".html", ".css", ".cpp", ".hpp", ".toml", ".yml", ".sh"})

NOT_READ = (
    "CHANGELOG.md",  # the history of the words too
    "tests/support/words.py",
    "worker/bench/stiffness.md",  # quotes the messages in its rows
)
"""Files that may hold the turns."""

_TURN = re.compile("|".join(r"\b" + r"[\s#/*]+".join(turn.split()) + r"\b" for turn in TURNS), re.IGNORECASE)
"""Also over the end of a line, where the next begins as a comment does."""

_JS_NAME = re.compile(rf"\b(?:const|let|function)\s+(?P<name>{'|'.join(sorted(NAMES))})\b")


def problems(name: str, text: str) -> Iterator[str]:
    """Each banned turn and name in the file `name` with the content `text`, as `path:line: what`."""
    for match in _TURN.finditer(text):
        yield f"{name}:{_line(text, match)}: the turn {' '.join(match[0].split())!r}"
    if name.endswith(".py"):
        for node in ast.walk(ast.parse(text)):
            for each in _defined(node):
                if each.lstrip("_").lower() in NAMES:
                    yield f"{name}:{getattr(node, 'lineno', 1)}: the name {each!r}"
    elif name.endswith(".js"):
        for match in _JS_NAME.finditer(text):
            yield f"{name}:{_line(text, match)}: the name {match['name']!r}"


def files() -> Iterable[Path]:
    """The files of the repository that are read."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in listed.stdout.split("\0"):
        path = ROOT / name
        read = path.suffix in SUFFIXES or path.name == "Makefile"
        if read and name not in NOT_READ and path.is_file():
            yield path


def main() -> int:
    """Print what is banned, and return 1 if there is anything."""
    lines = [
        line for path in files() for line in problems(path.relative_to(ROOT).as_posix(), path.read_text())
    ]
    print(*lines, sep="\n", end="\n" if lines else "")
    return 1 if lines else 0


def _line(text: str, match: re.Match[str]) -> int:
    return text.count("\n", 0, match.start()) + 1


def _defined(node: ast.AST) -> Iterator[str]:
    """The names that a node of a syntax tree gives to something."""
    match node:
        case (
            ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name)
        ):
            yield name
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            yield name
        case ast.alias(asname=str(name)) | ast.MatchAs(name=str(name)) | ast.ExceptHandler(name=str(name)):
            yield name


if __name__ == "__main__":
    sys.exit(main())

"""Printed output compared with the output that a page shows: the words must agree, the measurements may differ."""

from __future__ import annotations

import re

_TOKENS = re.compile(
    r"(?P<path>(?<!\S)/\S+)"
    r"|(?P<id>\b[0-9a-f]{16}\b)"
    r"|(?P<size>\b\d[\d,.]*\s(?:B|kB|MB|GB)\b)"
    r"|(?P<duration>\b(?:\d+h)?(?:\d+m)?\d+(?:\.\d+)?s\b)"
    r"|(?P<number>\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?)"
    r"|(?P<any>\.\.\.)"
    r"|(?P<space>\s+)"
)
_PATTERNS = {
    "path": r"/\S+",
    "id": r"[0-9a-f]{16}",
    "size": r"\d[\d,.]* (?:B|kB|MB|GB)",
    "duration": r"(?:\d+h)?(?:\d+m)?\d+(?:\.\d+)?s",
    "number": r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?",
    "any": r".*",
    "space": r"[^\S\n]+",
}


def mismatch(shown: str, printed: str) -> str | None:
    """Why `printed` does not have the shape of `shown`; None where it has.

    Every line of `shown` must be found in `printed`, in order and without lines between them, except where `shown` has
    a line `...`, which stands for any number of lines. Within a line, a number, size, duration, id or path stands for
    any other, `...` for any text, and white space for any white space.
    """
    lines = [line.strip() for line in shown.strip("\n").splitlines()]
    text = "".join(f"{line.strip()}\n" for line in printed.strip("\n").splitlines())
    patterns = [r"(?:.*\n)*?" if line == "..." else f"{shape_of(line)}\n" for line in lines]
    if re.fullmatch("".join(patterns), text):
        return None
    for count in range(len(lines), 0, -1):
        if re.match("".join(patterns[: count - 1]), text) and not re.match("".join(patterns[:count]), text):
            return f"there is no line like {lines[count - 1]!r} where it is expected, in:\n{printed}"
    return f"there is more than is shown, in:\n{printed}"


def shape_of(line: str) -> str:
    """The regular expression for lines of the same shape."""
    parts, at = [], 0
    for token in _TOKENS.finditer(line):
        kind = token.lastgroup
        assert kind is not None
        parts += [re.escape(line[at : token.start()]), _PATTERNS[kind]]
        at = token.end()
    return "".join([*parts, re.escape(line[at:])])

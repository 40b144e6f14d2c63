"""Durations, sizes, counts and lists as people write them: `90s`, `1h30m`, `1.5GB`, `1 photo`, `a, b, c and 4 more`."""

import re
from collections.abc import Sequence
from typing import Any

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
_DURATION = re.compile(r"(?:(?:\d+(?:\.\d+)?)[smhd])+", re.ASCII)
_DURATION_PART = re.compile(r"(\d+(?:\.\d+)?)([smhd])", re.ASCII)

_LONGEST = 40
"""Characters of a size. Longer ones may be infinite as a number."""

_BYTES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_BYTES_BINARY = {"k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
_SIZE = re.compile(r"(\d+(?:\.\d+)?) ?([kmgt]?)(i?)b?", re.ASCII | re.IGNORECASE)
_PLAIN = re.compile(r"\d+(?:\.\d+)?", re.ASCII)


def parse_duration(value: Any) -> Any:
    """Return the seconds of `"90s"`, `"5m"`, `"1h30m"` or `"2.5"`; a value that is no text is returned unchanged.

    Raises ValueError, which names the accepted forms, for any other text.
    """
    if not isinstance(value, str):
        return value
    text = value.strip().lower().replace(" ", "")
    if _PLAIN.fullmatch(text):
        return float(text)
    if not _DURATION.fullmatch(text):
        raise ValueError(f"{value[:80]!r} is not a duration; write seconds (90), or 90s, 5m, 1h30m")
    return sum(float(number) * _SECONDS[unit] for number, unit in _DURATION_PART.findall(text))


def parse_bytes(value: Any) -> Any:
    """Return the bytes of `"500MB"`, `"1.5GB"` or `"2GiB"`; a value that is no text is returned unchanged.

    Raises ValueError, which names the accepted forms, for any other text.
    """
    if not isinstance(value, str):
        return value
    match = _SIZE.fullmatch(value.strip()) if len(value) <= _LONGEST else None
    if match is None:
        raise ValueError(f"{value[:80]!r} is not a size; write bytes (500000000), or 500MB, 1.5GB, 2GiB")
    number, unit, binary = match.groups()
    if binary and not unit:
        raise ValueError(f"{value[:80]!r} is not a size; write bytes (500000000), or 500MB, 1.5GB, 2GiB")
    factor = _BYTES_BINARY[unit.lower()] if binary else _BYTES[unit.lower()]
    return round(float(number) * factor)


def format_duration(seconds: float) -> str:
    """Return seconds as rounded text for people: `4.2s`, `1m05s`, `2h03m`."""
    if seconds < 9.95:
        return f"{seconds:.1f}s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole}s"
    if whole < 3600:
        return f"{whole // 60}m{whole % 60:02d}s"
    minutes = round(seconds / 60)
    return f"{minutes // 60}h{minutes % 60:02d}m"


def format_bytes(count: float) -> str:
    """Return a number of bytes as text in decimal units: `512 B`, `1.5 MB`, `23.0 GB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def counted(number: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun: `1 photo`, `12 photos`; `many` is the plural where it is not `one` with an s."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"


def listed(names: Sequence[str], most: int = 3) -> str:
    """Return the first names as text, with the number of the others: `a, b, c and 4 more`."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")

"""Checks the header of a `.ply` file before it is read: readers believe its counts, and allocate for them."""

from __future__ import annotations

from pathlib import Path

MAX_HEADER_BYTES = 65536
"""Bytes of a header, which has a line per property and per comment."""

FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")

_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}

_TEXT_BYTES = 2
"""Bytes of a value in a text file, at least: a digit and a space."""


def check(path: Path) -> None:
    """Raise ValueError, with what is wrong, when the file is no .ply or too short for what its header announces.

    Rows with list properties, such as the faces of a mesh, are refused: neither point clouds nor splats have them. An
    element of no rows may have such properties, as that of the faces in files of programs for meshes.
    Raises OSError when the file cannot be opened.
    """
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    size = path.stat().st_size
    end = head.find(b"end_header")
    if not head.startswith(b"ply"):
        raise ValueError("it does not begin with 'ply'")
    if end < 0:
        raise ValueError(f"its header does not end within {min(size, MAX_HEADER_BYTES)} bytes")
    left = size - end - len(b"end_header")
    form, elements = _parsed(head[:end].decode("ascii", "replace"))
    for name, count, widths in elements:
        row = len(widths) * _TEXT_BYTES if form == "ascii" else sum(widths)
        needed = count * row - (1 if form == "ascii" and count else 0)  # the last line may lack its end
        if count < 0 or (count > 0 and row == 0) or needed > left:
            raise ValueError(
                f"its header announces {count} {name} rows of {row} bytes or more, and {left} bytes follow"
            )
        left -= needed


def _parsed(header: str) -> tuple[str, list[tuple[str, int, list[int]]]]:
    """The format, and the name, number of rows and widths of the properties of each element."""
    form = ""
    elements: list[tuple[str, int, list[int]]] = []
    for line in header.splitlines():
        match line.split():
            case ["format", kind, *_]:
                form = kind
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", *_]:
                if not elements or elements[-1][1] != 0:
                    raise ValueError(f"it has a list property ({line.strip()[:80]!r})")
            case ["property", kind, _] if kind in _BYTES and elements:
                elements[-1][2].append(_BYTES[kind])
            case ["property" | "element", *_]:
                raise ValueError(f"its header has the line {line.strip()[:80]!r}")
    if form not in FORMATS:
        raise ValueError(f"its format is {form[:80]!r}, none of {', '.join(FORMATS)}")
    return form, elements

"""Reads the header of a `.ply` file, and checks its counts against the file: readers believe them, and allocate for
them."""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass
from pathlib import Path

MAX_HEADER_BYTES = 65536
"""Bytes of a header, which has a line per property and per comment."""

FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""NumPy's names of the types of a header, without byte order."""

_TEXT_BYTES = 2
"""Bytes of a value in a text file, at least: a digit and a space."""

_BEGIN = re.compile(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\r|\n)")


@dataclass(frozen=True)
class Property:
    """A property of an element: its name, the header's name of its type, and that of the length where it is a list."""

    name: str
    kind: str
    length: str | None = None

    @property
    def least(self) -> int:
        """Bytes in a binary file; of a list, those of its length."""
        return int(TYPES[self.length or self.kind][1])


@dataclass(frozen=True)
class Element:
    """An element: its name, its number of rows, and the properties of a row."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def ragged(self) -> bool:
        """Whether its rows differ in length: it has rows, with lists in them."""
        return self.count != 0 and any(each.length for each in self.properties)


@dataclass(frozen=True)
class Header:
    """A header.

    form: one of FORMATS.
    elements: in the order of their rows.
    comments, obj_info: the texts of such lines, in ASCII.
    size: bytes before the first row.
    """

    form: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    obj_info: tuple[str, ...]
    size: int


def read(path: Path, *names: str) -> Header:
    """The header of a .ply file that is long enough for the rows up to those of the last element of `names`.

    Lines end in any way; bytes that are not ASCII become `\\xNN`. Raises ValueError, with what is wrong, when the file
    is no .ply, is too short, or has no element called names[0]; OSError when it cannot be opened.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # a pipe would keep its reader waiting
        raise ValueError("it is not a regular file")
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    size = status.st_size
    begin = _BEGIN.match(head)
    if begin is None:
        raise ValueError("it does not begin with 'ply'")
    # After a header whose lines end in \r alone, \n is a byte of the first row.
    end = re.compile(rb"[\r\n][ \t]*end_header[ \t]*" + (rb"\r" if begin[1] == b"\r" else rb"\r?\n")).search(
        head
    )
    if end is None:
        raise ValueError(f"its header does not end within {min(size, MAX_HEADER_BYTES)} bytes")
    header = _parsed(head[begin.end() : end.start()].decode("ascii", "backslashreplace"), end.end())
    known = [element.name for element in header.elements]
    if names[0] not in known:
        raise ValueError(f"it has no {names[0]} element; its elements are: {', '.join(known)[:80] or 'none'}")
    last = max(index for index, name in enumerate(known) if name in names)
    _check(header, header.elements[: last + 1], size - header.size)
    return header


def _check(header: Header, elements: tuple[Element, ...], left: int) -> None:
    """Raise ValueError where the rows of `elements` take more than the bytes that are `left`."""
    for element in elements:
        text = header.form == "ascii"
        row = sum(_TEXT_BYTES if text else each.least for each in element.properties)
        count = element.count
        needed = count * row - (1 if text and count else 0)  # the last line may lack its end
        if count < 0 or (count > 0 and row == 0) or needed > left:
            cut = ": it is cut off" if count > 0 and row > 0 else ""
            raise ValueError(
                f"its header announces {count} {element.name} rows of {row} bytes or more, and {left} bytes "
                f"follow{cut}"
            )
        left -= needed


def _parsed(text: str, size: int) -> Header:
    """The header with these lines between its first and its last one."""
    form = ""
    elements: list[tuple[str, int, list[Property]]] = []
    remarks: dict[str, list[str]] = {"comment": [], "obj_info": []}
    for line in text.splitlines():
        match line.split():
            case ["format", kind, *_]:
                form = kind
            case ["comment" | "obj_info" as kind, *_]:
                remarks[kind].append(line.strip().removeprefix(kind)[1:])
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and kind in TYPES and TYPES.get(length, "f")[0] in "iu"
            ):
                elements[-1][2].append(Property(name, kind, length))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1][2].append(Property(name, kind))
            case ["property" | "element", *_]:
                raise ValueError(f"its header has the line {line.strip()[:80]!r}")
    if form not in FORMATS:
        raise ValueError(f"its format is {form[:80]!r}, none of {', '.join(FORMATS)}")
    known = tuple(Element(name, count, tuple(properties)) for name, count, properties in elements)
    return Header(form, known, tuple(remarks["comment"]), tuple(remarks["obj_info"]), size)

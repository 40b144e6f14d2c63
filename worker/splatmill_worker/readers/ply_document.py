"""Reads the elements of a `.ply` that are asked for, whatever other elements, lists and comments a program adds.

plyfile would read all elements, and lists row by row; it takes no comment that is not ASCII. It is therefore given the
elements up to the last one that is asked for, without lists: tables of a binary file, and lines of a text.
"""

from __future__ import annotations

import io
import mmap
import struct
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from splatmill_worker.readers import ply_header, reader_memory
from splatmill_worker.readers.ply_header import TYPES, Element, Header, Property

_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
"""The codes of `struct` for lengths of lists."""

_PLACE_BYTES = 8
"""Bytes that are kept of a place in a row with lists, while its values are gathered."""

_Table = npt.NDArray[Any]


def read(path: Path, *names: str) -> PlyData:
    """The elements `names` of a .ply, of which the first must be there; their lists are left out.

    Elements between these are kept too if they have no lists. All comments are those of the document.

    Raises ValueError and PlyParseError for a file that is no .ply or is damaged, and OSError.
    """
    header = ply_header.read(path, *names)
    places = [index for index, element in enumerate(header.elements) if element.name in names]
    elements = header.elements[: places[-1] + 1]
    kept = [each for each in elements[places[0] :] if each.name in names or not each.ragged]
    if header.form == "ascii":
        with path.open("rb") as file:
            file.seek(header.size)
            lines = _lines(io.TextIOWrapper(file, "ascii", "replace"), elements, kept)
            return cast(PlyData, PlyData.read(_Text(header, kept, lines)))
    order = ">" if header.form.endswith("big_endian") else "<"
    tables = _tables(path, header, elements, kept, order)
    return PlyData(
        [PlyElement.describe(table, each.name) for each, table in zip(kept, tables, strict=True)],
        byte_order=order,
        comments=list(header.comments),
        obj_info=list(header.obj_info),
    )


def _plain(element: Element) -> list[Property]:
    return [each for each in element.properties if not each.length]


def _tables(
    path: Path, header: Header, elements: Sequence[Element], kept: Sequence[Element], order: str
) -> Iterator[_Table]:
    """The rows of each of `kept` in a binary file: mapped into memory, or gathered where they have lists."""
    place, size = header.size, path.stat().st_size
    for element in elements:
        if element in kept and not _plain(element):
            raise ValueError(f"its {element.name} rows hold nothing but lists")
        row = np.dtype([(each.name, order + TYPES[each.kind]) for each in _plain(element)])
        if element.ragged:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                place, starts = _walked(data, place, element, order)
                if element in kept:
                    yield _gathered(data, element, starts).view(row)[:, 0]
            continue
        end = place + element.count * row.itemsize
        if end > size:
            raise ValueError(f"it ends before the last of its {element.count} {element.name} rows")
        if element in kept:
            mapped = element.count * row.itemsize > 0
            yield (
                np.memmap(path, row, "c", place, (element.count,)) if mapped else np.empty(element.count, row)
            )
        place = end


def _walked(data: mmap.mmap, place: int, element: Element, order: str) -> tuple[int, list[array[int]]]:
    """The end of the rows of an element that begin at `place`, and where in each of them the values before each list
    begin, and those behind the last one."""
    runs = _runs(element)
    lists = [each for each in element.properties if each.length]
    gathered = element.count * 2 * (sum(runs) + _PLACE_BYTES * len(runs))
    reader_memory.check(f"reading its {element.name} rows, which hold lists,", gathered, len(data))
    steps = [
        (run, struct.Struct(order + _CODES[TYPES[each.length or ""]]), int(TYPES[each.kind][1]))
        for run, each in zip(runs, lists, strict=False)
    ]
    starts = [array("q") for _ in runs]
    added = [each.append for each in starts]
    size, last = len(data), runs[-1]
    for number in range(element.count):
        for add, (run, length, width) in zip(added, steps, strict=False):
            add(place)
            place += run
            if place + length.size > size:
                raise ValueError(f"it ends in row {number} of {element.count} {element.name} rows")
            (count,) = length.unpack_from(data, place)
            if count < 0:
                raise ValueError(f"a list in row {number} of its {element.name} rows has {count} values")
            place += length.size + count * width
        added[-1](place)
        place += last
        if place > size:
            raise ValueError(f"it ends in row {number} of {element.count} {element.name} rows")
    return place, starts


def _runs(element: Element) -> list[int]:
    """Bytes of the values before each list of a row, and of those behind the last one."""
    runs = [0]
    for each in element.properties:
        if each.length:
            runs.append(0)
        else:
            runs[-1] += each.least
    return runs


def _gathered(data: mmap.mmap, element: Element, starts: list[array[int]]) -> npt.NDArray[np.uint8]:
    """The bytes [rows, row] of an element without its lists."""
    runs = _runs(element)
    content: npt.NDArray[np.uint8] = np.frombuffer(data, np.uint8)
    values = np.empty((element.count, sum(runs)), np.uint8)
    column = 0
    for run, places in zip(runs, starts, strict=True):
        at = np.frombuffer(places, np.int64)
        for byte in range(run):
            values[:, column] = content[at + byte]
            column += 1
    return values


class _Text(io.TextIOBase):
    """A .ply of text for plyfile, which reads the header by characters, and then lines."""

    def __init__(self, header: Header, elements: Sequence[Element], lines: Iterator[str]) -> None:
        head = ["ply", "format ascii 1.0", *(f"comment {text}" for text in header.comments)]
        head += [f"obj_info {text}" for text in header.obj_info]
        for element in elements:
            head.append(f"element {element.name} {element.count}")
            head += [f"property {each.kind} {each.name}" for each in _plain(element)]
        self._head = io.StringIO("\n".join([*head, "end_header", ""]))
        self._lines = lines

    def read(self, size: int | None = -1, /) -> str:
        return self._head.read(size)

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # plyfile reads texts
        return next(self._lines, "")


def _lines(lines: Iterator[str], elements: Sequence[Element], kept: Sequence[Element]) -> Iterator[str]:
    """The lines of each of `kept` in a text file, without their lists."""
    for element in elements:
        for line in islice(lines, element.count):
            if element in kept:
                yield _unlisted(line, element) if element.ragged else line


def _unlisted(line: str, element: Element) -> str:
    """A line of text without its lists."""
    fields, place, values = line.split(), 0, []
    for each in element.properties:
        if place >= len(fields):
            raise ValueError(f"a line of its {element.name} rows has {len(fields)} values, which are too few")
        if each.length:
            place += 1 + max(0, int(fields[place]))
        else:
            values.append(fields[place])
            place += 1
    return " ".join(values) + "\n"

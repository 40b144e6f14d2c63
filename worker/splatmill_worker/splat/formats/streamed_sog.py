"""Streamed SOG, version 1: a model in levels of detail, as a `lod-meta.json` and folders of unpacked SOG beside it.

Source: PlayCanvas, "The Streamed SOG Format" (developer.playcanvas.com, user manual, Gaussian splatting). The far
surroundings of a scene are its `environment`, which stands outside of the tree, so that viewers frame the scene.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.errors import ModelUnreadable, UnusablePicture
from splatmill_worker.images.archives.archive import DAMAGED
from splatmill_worker.readers.reader_memory import COPIES, check, parameter_bytes
from splatmill_worker.splat.formats import sog, sog_files
from splatmill_worker.splat.formats.contents import (
    NO_OFFSET,
    Contents,
    Offset,
    gathered,
    on_cpu,
    visible_rows,
)
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.boxes import leaf_boxes
from splatmill_worker.splat.lod.levels import Division, Levels, divide
from splatmill_worker.splat.lod.partition import Node
from splatmill_worker.wording import plain

VERSION = 1

CHUNK = 65536
"""Gaussians of a chunk at most, which is what a viewer loads at a time: about 1.2 MB."""

INDEX = "lod-meta.json"

ENVIRONMENT = "env/meta.json"

DAMAGE = (
    *DAMAGED,
    OSError,
    ValueError,
    OverflowError,
    LookupError,
    TypeError,
    AttributeError,
    RecursionError,
)
"""What reading a document of unexpected contents raises, or an archive."""

MAX_INDEX_BYTES = 2**23
"""Bytes of a `lod-meta.json`, of which a leaf takes some 400; Python takes up to thirty times as many to parse it."""


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Make the levels of `gaussians` and write them beside `path`, a `lod-meta.json`; returns how many level 0 has.

    Those of the surroundings are counted too. Rows with a non-finite parameter and rows with an opacity under
    MIN_OPACITY of the `.ply` are left out. offset, antialiased: of `Contents`.

    An index that is there is removed first and the new one is written last, so that none names files of another model.
    """
    model, count = divided_visible(gaussians)
    write_levels(path, model, offset=offset, antialiased=antialiased)
    return count


def divided_visible(gaussians: Gaussians) -> tuple[Division, int]:
    """The rows of a model that a file holds, for `encoded`, and how many they are."""
    gaussians = on_cpu(gaussians)
    rows = visible_rows(gaussians)
    return divide(gaussians, rows), int(rows.sum())


def write_levels(
    path: Path,
    levels: Levels | Division,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    chunk: int = CHUNK,
) -> None:
    """Write levels as `write` does. chunk: Gaussians of a chunk at most, unless a leaf has more."""
    path.unlink(missing_ok=True)
    for name, content in encoded(levels, offset=offset, antialiased=antialiased, chunk=chunk):
        atomic_write(path if name == INDEX else path.parent / name, content, sync=name == INDEX)


def encoded(
    levels: Levels | Division,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    chunk: int = CHUNK,
) -> Iterator[tuple[str, bytes]]:
    """The files of a model by their paths: those of each chunk together, and the index last. Else as `write_levels`.

    A chunk is written as soon as it is full, so that memory holds one of each level and two parts of `levels`.
    """
    chunks, boxes, counts = list[_Chunks](), list[Tensor](), Counter[int]()
    for part in levels.parts():
        boxes.append(leaf_boxes(part))
        chunks = chunks or [_Chunks(number, chunk) for number in range(len(part))]
        for number, (level, waiting) in enumerate(zip(part, chunks, strict=True)):
            counts[number] += level.gaussians.count
            for run, error in zip(level.runs, level.errors, strict=True):
                if not waiting.has_room(run.count):
                    yield from _sog(waiting.name, waiting.take(), offset, antialiased)
                waiting.add(level.gaussians.select(slice(run.first, run.first + run.count)), error)
    for waiting in chunks:
        yield from _sog(waiting.name, waiting.take(), offset, antialiased)
    if levels.surroundings is not None:
        yield from _sog(ENVIRONMENT, levels.surroundings, offset, antialiased)
    index: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "Splatmill"},
        "count": counts.total(),
        "counts": [counts[number] for number in range(len(chunks))],
        "lodLevels": len(chunks),
        "lodErrors": True,
    }
    if levels.surroundings is not None:
        index["environment"] = ENVIRONMENT
    index["filenames"] = [name for each in chunks for name in each.names]
    index["tree"] = _tree(levels.tree, torch.cat(boxes, 1), chunks)
    yield INDEX, json.dumps(index, separators=(",", ":")).encode()


@dataclass
class _Chunks:
    """The chunks of a level: runs of neighbouring leaves, which lie in one SOG.

    level: its number, 0 for the finest. most: Gaussians of a chunk, unless a leaf has more.
    names: of the SOGs that are full. places: of each leaf, the number of its SOG, the first Gaussian there and how many
    there are. errors: of each leaf.
    """

    level: int
    most: int
    names: list[str] = field(default_factory=list)
    places: list[tuple[int, int, int]] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    _runs: list[Gaussians] = field(default_factory=list)
    _count: int = 0

    @property
    def name(self) -> str:
        """The path of the SOG that is filled."""
        return f"{self.level}_{len(self.names)}/meta.json"

    def has_room(self, count: int) -> bool:
        """Whether a leaf of so many Gaussians goes into the chunk that is filled."""
        return not self._runs or self._count + count <= self.most

    def add(self, run: Gaussians, error: float) -> None:
        """Add the Gaussians of the next leaf."""
        self.places.append((len(self.names), self._count, run.count))
        self.errors.append(error)
        self._runs.append(run)
        self._count += run.count

    def take(self) -> Gaussians:
        """The Gaussians of the chunk that is filled; the next begins."""
        self.names.append(self.name)
        runs, self._runs, self._count = self._runs, [], 0
        return concatenate(*runs)


def read(path: Path) -> Contents:
    """Read level 0 and the environment of a `lod-meta.json`.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    with unreadable(path, "Streamed SOG"), opened(path) as document:
        return joined([document.part(name) for name in finest(document.index)])


@dataclass(frozen=True)
class Document:
    """An opened model in levels of detail.

    index: the document in its `lod-meta.json`. part: the files of the SOG whose `meta.json` the index names.
    """

    index: Any
    part: Callable[[str], sog_files.Files]


@contextmanager
def opened(path: Path) -> Iterator[Document]:
    """The model of a `lod-meta.json`. Raises what `unreadable` turns into ModelUnreadable."""
    if path.stat().st_size > MAX_INDEX_BYTES:
        raise ValueError(f"it has more than {MAX_INDEX_BYTES} bytes")

    def part(name: str) -> sog_files.Files:
        if not (path.parent / name).is_file():
            raise ValueError(f"it names {name[:80]}, which is missing beside it")
        return sog_files.Beside(path.parent / name)

    yield Document(json.loads(path.read_bytes()), part)


@contextmanager
def unreadable(path: Path, what: str) -> Iterator[None]:
    """Turn what reading damaged or foreign files raises into ModelUnreadable, but for FileNotFoundError.

    what: what the file was read as.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except UnusablePicture as error:
        raise ModelUnreadable(f"{path.name} cannot be read: {error.message}") from error
    except DAMAGE as error:
        raise ModelUnreadable(f"{path.name} could not be read as {what}: {plain(error)}.") from error


def joined(parts: Sequence[sog_files.Files]) -> Contents:
    """The contents of at least one SOG as those of one model, with the offset and the notes of the first.

    It takes the memory of the model, and for one part at a time what reading a SOG takes.
    """
    count = degree = largest = size = 0
    for part in parts:  # their documents are not kept: each may take 30 MB
        head = sog.header(part)
        count, size = count + head.count, size + head.bytes
        degree, largest = max(degree, head.degree), max(largest, head.count)
    needed = parameter_bytes(degree) * (count + COPIES * largest)
    check(f"reading its {count:,} Gaussians", needed, size)
    facts: dict[str, Any] = {}

    def pieces() -> Iterator[Gaussians]:
        for part in parts:
            yield _piece(part, facts)

    return Contents(gathered(count, degree, pieces()), **facts)


def _piece(part: sog_files.Files, facts: dict[str, Any]) -> Gaussians:
    """The Gaussians of a SOG. facts: gets the other fields of its contents if it is empty."""
    contents = sog.contents(part)
    if not facts:
        facts |= {"offset": contents.offset, "antialiased": contents.antialiased, "notes": contents.notes}
    return contents.gaussians


def files(path: Path) -> list[Path]:
    """The files of a model that `write` has written: `path`, and those of its chunks and of its environment."""
    index = json.loads(path.read_bytes())
    names = [*index["filenames"], *([index["environment"]] if "environment" in index else [])]
    return [path, *(file for name in names for file in sorted((path.parent / name).parent.iterdir()))]


def _sog(meta: str, gaussians: Gaussians, offset: Offset, antialiased: bool) -> Iterator[tuple[str, bytes]]:
    for name, content in sog.encoded(gaussians, offset=offset, antialiased=antialiased):
        yield str(PurePosixPath(meta).with_name(name)), content


def _tree(tree: Node, boxes: Tensor, chunks: Sequence[_Chunks]) -> dict[str, Any]:
    """The tree with its boxes, and the places of the runs of each leaf.

    boxes: of the leaves (`leaf_boxes`). chunks: of each level, whose files are one after the other.
    """
    firsts = [0, *accumulate(len(each.names) for each in chunks)]

    def leaf(number: int) -> dict[str, Any]:
        lods = {}
        for first, each in zip(firsts, chunks, strict=False):
            file, offset, count = each.places[number]
            lods[str(each.level)] = {"file": first + file, "offset": offset, "count": count}
        return {"lods": lods, "errors": [_short(each.errors[number]) for each in chunks]}

    def built(node: Node) -> dict[str, Any]:
        low = boxes[0, node.first : node.last].amin(0)
        high = boxes[1, node.first : node.last].amax(0)
        bound = {"min": [*map(_short, low.tolist())], "max": [*map(_short, high.tolist())]}
        if node.children is None:
            return {"bound": bound} | leaf(node.first)
        return {"bound": bound, "children": [built(child) for child in node.children]}

    return built(tree)


def _short(number: float) -> float:
    """The number with seven significant digits, as the specification has it."""
    return float(f"{number:.7g}")


def finest(index: Any) -> list[str]:
    """The paths of the SOG of level 0 and of the environment, none of which leads out of the folder.

    index: the document in a `lod-meta.json`. Raises ValueError, KeyError, TypeError, IndexError or AttributeError for
    another one.
    """
    numbers = dict.fromkeys(node["lods"]["0"]["file"] for node in leaves(index) if "0" in node["lods"])
    names = [*dict.fromkeys(index["filenames"][file] for file in numbers)]
    names += [index["environment"]] if index.get("environment") else []
    if not names:
        raise ValueError("its tree has no leaf with level 0")
    check_names(names)
    return names


def leaves(index: Any) -> Iterator[Any]:
    """The nodes of the tree of an index that have levels, in its order. Raises as `finest`."""
    if index["version"] != VERSION:
        raise ValueError(f"its version is {index['version']!r:.20}, and only version {VERSION} is read")
    nodes = [index["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += reversed(node.get("children", []))
        if "lods" in node:
            yield node


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError for the path of a SOG that leads out of the folder of its index."""
    for name in names:
        place = PurePosixPath(name)
        if place.is_absolute() or ".." in place.parts or place.name != "meta.json":
            raise ValueError(f"it names {name[:80]!r}, which is no meta.json in a folder beside it")

"""Streamed SOG, version 1: a model in levels of detail, as a `lod-meta.json` and folders of unpacked SOG beside it.

Source: PlayCanvas, "The Streamed SOG Format" (developer.playcanvas.com, user manual, Gaussian splatting). The far
surroundings of a scene are its `environment`, which stands outside of the tree, so that viewers frame the scene.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from splatmill.files import atomic_write
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import sog
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset, visible
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.boxes import leaf_boxes
from splatmill_worker.splat.lod.levels import Level, Levels, make_levels
from splatmill_worker.splat.lod.partition import Node
from splatmill_worker.wording import plain

VERSION = 1

CHUNK = 65536
"""Gaussians of a chunk at most, which is what a viewer loads at a time: about 1.2 MB."""

INDEX = "lod-meta.json"

ENVIRONMENT = "env/meta.json"

MAX_INDEX_BYTES = 2**23
"""Bytes of a `lod-meta.json`, of which a leaf takes some 400; Python takes up to thirty times as many to parse it."""


@dataclass(frozen=True)
class Chunk:
    """Runs of neighbouring leaves in a level, which lie in one SOG.

    level: 0 is the finest.
    first, last: its leaves are those from `first` to before `last`.
    """

    level: int
    first: int
    last: int


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Make the levels of `gaussians` and write them beside `path`, a `lod-meta.json`; returns how many level 0 has.

    Those of the surroundings are counted too. Rows with a non-finite parameter and rows with an opacity under
    MIN_OPACITY of the `.ply` are left out. offset, antialiased: of `Contents`.

    An index that is there is removed first and the new one is written last, so that none names files of another model.
    """
    gaussians = visible(gaussians)
    write_levels(path, make_levels(gaussians), offset=offset, antialiased=antialiased)
    return gaussians.count


def write_levels(
    path: Path,
    levels: Levels,
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
    levels: Levels,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    chunk: int = CHUNK,
) -> Iterator[tuple[str, bytes]]:
    """The files of a model by their paths: those of each chunk together, and the index last. Else as `write_levels`."""
    chunks = [part for number, level in enumerate(levels.levels) for part in _chunks(number, level, chunk)]
    names, places = list[str](), dict[int, int]()
    for part in chunks:
        number = places[part.level] = places.get(part.level, -1) + 1
        names.append(f"{part.level}_{number}/meta.json")
        level = levels.levels[part.level]
        begin, end = level.runs[part.first].first, level.runs[part.last - 1]
        rows = torch.arange(begin, end.first + end.count)
        yield from _sog(names[-1], level.gaussians.select(rows), offset, antialiased)
    if levels.surroundings is not None:
        yield from _sog(ENVIRONMENT, levels.surroundings, offset, antialiased)
    yield INDEX, json.dumps(_index(levels, chunks, names), separators=(",", ":")).encode()


def read(path: Path) -> Contents:
    """Read level 0 and the environment of a `lod-meta.json`.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    try:
        if path.stat().st_size > MAX_INDEX_BYTES:
            raise ValueError(f"it has more than {MAX_INDEX_BYTES} bytes")
        names = finest(json.loads(path.read_bytes()))
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise ModelUnreadable(f"{path.name} could not be read as Streamed SOG: {plain(error)}.") from error
    parts = []
    for name in names:
        if not (part := path.parent / name).is_file():
            raise ModelUnreadable(f"{path.name} names {name[:80]}, which is missing beside it.")
        parts.append(sog.read(part))
    return joined(parts)


def joined(parts: Sequence[Contents]) -> Contents:
    """The contents of at least one SOG as those of one model."""
    degree = max(part.gaussians.degree for part in parts)
    whole = concatenate(*(part.gaussians.padded(degree) for part in parts))
    return Contents(whole, parts[0].offset, parts[0].antialiased, parts[0].notes)


def files(path: Path) -> list[Path]:
    """The files of a model that `write` has written: `path`, and those of its chunks and of its environment."""
    index = json.loads(path.read_bytes())
    names = [*index["filenames"], *([index["environment"]] if "environment" in index else [])]
    return [path, *(file for name in names for file in sorted((path.parent / name).parent.iterdir()))]


def _chunks(number: int, level: Level, most: int) -> Iterator[Chunk]:
    """The runs of a level in chunks, each as large as it may be; a leaf is in one."""
    first = count = 0
    for leaf, run in enumerate(level.runs):
        if leaf > first and count + run.count > most:
            yield Chunk(number, first, leaf)
            first, count = leaf, 0
        count += run.count
    yield Chunk(number, first, len(level.runs))


def _sog(meta: str, gaussians: Gaussians, offset: Offset, antialiased: bool) -> Iterator[tuple[str, bytes]]:
    for name, content in sog.encoded(gaussians, offset=offset, antialiased=antialiased):
        yield str(PurePosixPath(meta).with_name(name)), content


def _index(levels: Levels, chunks: list[Chunk], names: list[str]) -> dict[str, Any]:
    counts = [level.gaussians.count for level in levels.levels]
    index: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "Splatmill"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(counts),
        "lodErrors": True,
    }
    if levels.surroundings is not None:
        index["environment"] = ENVIRONMENT
    return index | {"filenames": names, "tree": _tree(levels, chunks)}


def _tree(levels: Levels, chunks: list[Chunk]) -> dict[str, Any]:
    """The tree with its boxes, and the places of the runs of each leaf."""
    leaves: list[dict[str, Any]] = [{"lods": {}, "errors": []} for _ in levels.levels[0].runs]
    for file, chunk in enumerate(chunks):
        runs = levels.levels[chunk.level].runs
        for leaf in range(chunk.first, chunk.last):
            place = {
                "file": file,
                "offset": runs[leaf].first - runs[chunk.first].first,
                "count": runs[leaf].count,
            }
            leaves[leaf]["lods"][str(chunk.level)] = place
            leaves[leaf]["errors"].append(_short(levels.levels[chunk.level].errors[leaf]))
    boxes = leaf_boxes(levels)

    def built(node: Node) -> dict[str, Any]:
        low = boxes[0, node.first : node.last].amin(0)
        high = boxes[1, node.first : node.last].amax(0)
        bound = {"min": [*map(_short, low.tolist())], "max": [*map(_short, high.tolist())]}
        if node.children is None:
            return {"bound": bound} | leaves[node.first]
        return {"bound": bound, "children": [built(child) for child in node.children]}

    return built(levels.tree)


def _short(number: float) -> float:
    """The number with seven significant digits, as the specification has it."""
    return float(f"{number:.7g}")


def finest(index: Any) -> list[str]:
    """The paths of the SOG of level 0 and of the environment, none of which leads out of the folder.

    index: the document in a `lod-meta.json`. Raises ValueError, KeyError, TypeError, IndexError or AttributeError for
    another one.
    """
    if index["version"] != VERSION:
        raise ValueError(f"its version is {index['version']!r:.20}, and only version {VERSION} is read")
    found = dict[int, None]()
    nodes = [index["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += reversed(node.get("children", []))
        if "0" in node.get("lods", {}):
            found[node["lods"]["0"]["file"]] = None
    names = [*dict.fromkeys(index["filenames"][file] for file in found)]
    names += [index["environment"]] if index.get("environment") else []
    if not names:
        raise ValueError("its tree has no leaf with level 0")
    for name in names:
        place = PurePosixPath(name)
        if place.is_absolute() or ".." in place.parts or place.name != "meta.json":
            raise ValueError(f"it names {name[:80]!r}, which is no meta.json in a folder beside it")
    return names

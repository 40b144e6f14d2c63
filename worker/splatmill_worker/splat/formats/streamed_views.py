"""Views of a model in levels of detail: each reads the chunks that it draws, so that memory need not hold the model."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from splatmill.schema.files.formats import format_of
from splatmill_worker.readers.reader_memory import check, limit, parameter_bytes
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats import sog, streamed_sog, streamed_zip
from splatmill_worker.splat.formats.contents import Contents, gathered
from splatmill_worker.splat.formats.streamed_sog import Document, unreadable
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lod.choice import TOLERANCE, Leaves, choose

COPIES = 3
"""Times the memory of its Gaussians that a view takes: theirs, and what drawing them takes."""

KEPT_SHARE = 4
"""Memory that is free over that of the chunks that are kept for the next view."""

MOST_LEVELS = 32
"""Levels that a model may have. Those that are written here have a quarter of the Gaussians of the one before."""

Places = npt.NDArray[np.int64]


class LeveledModel:
    """A model in levels of detail, open for reading.

    overview: the coarsest level and the surroundings, and what the files say.
    count: Gaussians of level 0 and the surroundings.
    tolerance: pixels, the largest that a view was drawn with.
    """

    def __init__(self, path: Path, document: Document) -> None:
        index = document.index
        names = [str(name) for name in index["filenames"]]
        environment = index.get("environment")
        streamed_sog.check_names([*names, *([environment] if environment else [])])
        self._document, self._names, self._path = document, names, path
        self._leaves, self._places = leaves_of(index)
        counts, self._degree, self._bytes = list[int](), 0, 0
        for name in names:  # their documents are not kept: each may take 30 MB
            head = sog.header(document.part(name))
            counts.append(head.count)
            self._degree, self._bytes = max(self._degree, head.degree), self._bytes + head.bytes
        _check_places(self._places, self._leaves.counts, counts)
        self._kept: OrderedDict[int, Gaussians] = OrderedDict()
        facts = sog.contents(document.part(environment or names[0]))
        self._surroundings = facts.gaussians if environment else facts.gaussians.select(slice(0))
        self._degree = max(self._degree, self._surroundings.degree)
        self.count = int(self._leaves.counts[:, 0].sum()) + self._surroundings.count
        self.tolerance = TOLERANCE
        coarsest = np.full(len(self._places), self._leaves.counts.shape[1] - 1)
        self.overview = Contents(self._drawn(coarsest), facts.offset, facts.antialiased, facts.notes)

    def seen_by(self, camera: Camera) -> Gaussians:
        """The Gaussians that `camera` draws: of each leaf in view the level that is within TOLERANCE pixels of its
        place, or a coarser one where memory holds no more. Raises ModelUnreadable for damaged files.
        """
        most = limit() // (COPIES * parameter_bytes(self._degree)) - self._surroundings.count
        choice = choose(self._leaves, camera, most)
        self.tolerance = max(self.tolerance, choice.tolerance)
        with unreadable(self._path, streamed_zip.WHAT):
            return self._drawn(choice.levels)

    def _drawn(self, levels: Places) -> Gaussians:
        """The runs of the leaves at the given levels, and the surroundings; -1: not the leaf."""
        leaves = np.flatnonzero(levels >= 0)
        counts = self._leaves.counts[leaves, levels[leaves]]
        count = int(counts.sum()) + self._surroundings.count
        needed = COPIES * parameter_bytes(self._degree) * count
        check(f"drawing {count:,} of its Gaussians", needed, self._bytes)
        files, firsts = self._places[leaves, levels[leaves]].T

        def pieces() -> Iterator[Gaussians]:
            for file in np.unique(files):
                rows = [
                    torch.arange(first, first + many)
                    for first, many in zip(firsts[files == file], counts[files == file], strict=True)
                ]
                yield _finite(self._chunk(int(file)).select(torch.cat(rows)))
            yield self._surroundings

        return gathered(count, self._degree, pieces())

    def _chunk(self, file: int) -> Gaussians:
        """All rows of a SOG, from memory where they are kept."""
        chunk = self._kept.pop(file, None)
        if chunk is None:
            chunk, _ = sog.rows(self._document.part(self._names[file]))
        self._kept[file] = chunk
        most = limit() // KEPT_SHARE
        while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > most:
            self._kept.popitem(last=False)
        return chunk


@contextmanager
def opened(path: Path) -> Iterator[LeveledModel | None]:
    """A model in levels of detail; None for a file of another format, and for levels of unknown errors.

    Raises ModelUnreadable for a damaged file, and FileNotFoundError where there is none.
    """
    found = format_of(path.name)
    suffix = None if found is None else found.suffix
    if suffix not in ("lod-meta.json", ".lod.zip"):
        yield None
        return
    with ExitStack() as stack:
        with unreadable(path, streamed_zip.WHAT):
            source = streamed_zip.opened if suffix == ".lod.zip" else streamed_sog.opened
            document = stack.enter_context(source(path))
            known = document.index.get("lodErrors") is True
            model = LeveledModel(path, document) if known else None
        yield model


def leaves_of(index: Any) -> tuple[Leaves, Places]:
    """The leaves of an index, and for each level of each the number of its SOG and its first row there, int64 [leaves,
    levels, 2].

    Raises ValueError, LookupError, TypeError or AttributeError for another document, and for one without errors.
    """
    levels = index["lodLevels"]
    if type(levels) is not int or not 0 < levels <= MOST_LEVELS:
        raise ValueError(f"it has {levels!r:.20} levels")
    found, nodes = [], [index["tree"]]
    while nodes:
        node = nodes.pop()
        if "children" in node:
            nodes += reversed(node["children"])
            continue
        lods = [node["lods"][str(level)] for level in range(levels)]
        counts, places = [lod["count"] for lod in lods], [(lod["file"], lod["offset"]) for lod in lods]
        bound = node["bound"]
        found.append((bound["min"], bound["max"], node["errors"], counts, places))
    columns = [*zip(*found, strict=True)]
    if [np.shape(column) for column in columns[:3]] != [(len(found), 3)] * 2 + [(len(found), levels)]:
        raise ValueError("a leaf of its tree has a box or errors of another length")
    low, high, errors = (np.array(column, float) for column in columns[:3])
    leaves = Leaves(low, high, errors, np.array(columns[3], np.int64))
    if not all(np.isfinite(values).all() for values in (leaves.low, leaves.high, leaves.errors)):
        raise ValueError("a leaf of its tree has a box or errors that are not finite")
    return leaves, np.array(columns[4], np.int64)


def _check_places(places: Places, counts: npt.NDArray[np.int64], sizes: list[int]) -> None:
    """Raise ValueError for a run that is not within its SOG, of which there are those of `sizes` rows."""
    files, firsts = places[..., 0], places[..., 1]
    if (files < 0).any() or (files >= len(sizes)).any():
        raise ValueError(f"a leaf of its tree names a file that is not among its {len(sizes)}")
    if (firsts < 0).any() or (counts < 0).any() or (firsts + counts > np.array(sizes)[files]).any():
        raise ValueError("a leaf of its tree has more Gaussians than the file that it names")


def _bytes(gaussians: Gaussians) -> int:
    return gaussians.count * parameter_bytes(gaussians.degree)


def _finite(gaussians: Gaussians) -> Gaussians:
    keep = gaussians.finite()
    return gaussians if bool(keep.all()) else gaussians.select(keep)

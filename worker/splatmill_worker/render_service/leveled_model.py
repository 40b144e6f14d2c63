"""Views of a model in levels of detail: each reads the chunks that it draws, so that memory need not hold the model."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema.files.formats import format_of
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.readers import reader_memory
from splatmill_worker.readers.reader_memory import check, limit, parameter_bytes
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats import sog, streamed_sog, streamed_zip
from splatmill_worker.splat.formats.contents import Contents, gathered
from splatmill_worker.splat.formats.sog_files import Files
from splatmill_worker.splat.formats.streamed_sog import unreadable
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lod.choice import TOLERANCE, Leaves, choose

COPIES = 3
"""Times the memory of its Gaussians that a view takes: theirs, and what gathering and drawing them take."""

KEPT_SHARE = 4
"""The memory of views over that of the chunks that are kept for the next view."""

MOST_LEVELS = 32
"""Levels that a model may have. Those that are written here have a quarter of the Gaussians of the one before."""

LARGEST = 1e30
"""Coordinates and errors are smaller, so that no product of them with a focal length overflows."""

Places = npt.NDArray[np.int64]


class LeveledModel:
    """A model in levels of detail, open for reading.

    overview: the coarsest level, or where it is empty the surroundings, and what the files say.
    tolerance: pixels, the largest that a view was drawn with.
    """

    def __init__(self, path: Path, index: Any, part: Callable[[str], Files]) -> None:
        """index, part: of the document in `path`. Raises what `unreadable` turns into ModelUnreadable."""
        self._path, self._part = path, part
        self._leaves, self._places = leaves_of(index)
        environment = index.get("environment")
        self._names: list[str] = [str(name) for name in index["filenames"]]
        streamed_sog.check_names([*self._names, *([environment] if environment else [])])
        used = np.unique(self._places[..., 0]).tolist()
        if not used or min(used) < 0 or max(used) >= len(self._names):
            raise ValueError(f"a leaf of its tree names a file that is not among its {len(self._names)}")
        counts, self._degree, self._bytes = np.zeros(len(self._names), np.int64), 0, 0
        heads = dict[str, tuple[int, int]]()
        for file in used:
            if (name := self._names[file]) not in heads:
                head = sog.header(part(name))  # whose document may take 30 MB, and is not kept
                heads[name] = head.count, head.degree
                self._bytes += head.bytes
                stated = sog.stated(head.meta)
            counts[file], degree = heads[name]
            self._degree = max(self._degree, degree)
        _check_places(self._places, self._leaves.counts, counts)
        self._kept: OrderedDict[str, Gaussians] = OrderedDict()
        self._surroundings = gathered(0, 0, [])
        notes: tuple[str, ...] = ()
        if environment:
            self._bytes += sog.header(part(environment)).bytes
            around = sog.contents(part(environment))
            self._surroundings, notes = around.gaussians, around.notes
            self._degree = max(self._degree, self._surroundings.degree)
            stated = around.offset, around.antialiased
        # What is left beside the largest chunk while it is read, for as long as the model is open.
        left = limit() - reader_memory.COPIES * parameter_bytes(self._degree) * int(counts.max())
        self._most_kept = max(0, left) // (KEPT_SHARE + 1)
        self._room = max(0, left) - self._most_kept
        self.tolerance = TOLERANCE
        coarsest = np.full(len(self._places), self._leaves.counts.shape[1] - 1)
        drawn = self._drawn(coarsest, self._surroundings.select(slice(0)))
        self.overview = Contents(drawn if drawn.count else self._surroundings, *stated, notes)

    def seen_by(self, camera: Camera) -> Gaussians:
        """The Gaussians that `camera` draws: of each leaf in view the level that is within TOLERANCE pixels of its
        place, or a coarser one where memory holds no more. Raises ModelUnreadable for damaged files.
        """
        room = min(self._room, limit())
        most = room // (COPIES * parameter_bytes(self._degree)) - self._surroundings.count
        choice = choose(self._leaves, camera, most)
        self.tolerance = max(self.tolerance, choice.tolerance)
        with unreadable(self._path, streamed_zip.WHAT):
            return self._drawn(choice.levels, self._surroundings)

    def _drawn(self, levels: Places, surroundings: Gaussians) -> Gaussians:
        """The runs of the leaves at the given levels, and the surroundings; -1: not the leaf."""
        leaves = np.flatnonzero(levels >= 0)
        counts = self._leaves.counts[leaves, levels[leaves]]
        count = int(counts.sum()) + surroundings.count
        needed = COPIES * parameter_bytes(self._degree) * count
        check(f"drawing {count:,} of its Gaussians", needed, self._bytes)
        files, firsts = self._places[leaves, levels[leaves]].T

        def pieces() -> Iterator[Gaussians]:
            for file in np.unique(files):
                chunk = self._chunk(self._names[file])
                for first, many in zip(firsts[files == file], counts[files == file], strict=True):
                    yield _finite(chunk.select(slice(int(first), int(first + many))))
                del chunk  # before the next is read
            yield surroundings

        return gathered(count, self._degree, pieces())

    def _chunk(self, name: str) -> Gaussians:
        """All rows of a SOG, from memory where they are kept."""
        chunk = self._kept.pop(name, None)
        if chunk is None:
            chunk, _ = sog.rows(self._part(name))
        self._kept[name] = chunk
        while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > self._most_kept:
            self._kept.popitem(last=False)
        return chunk


@contextmanager
def opened(path: Path) -> Iterator[LeveledModel | None]:
    """A model in levels of detail. None for a file of another format, and for one of which views cannot choose levels,
    such as one that does not state their errors: it may still be read whole, or the reader says what it lacks."""
    model_format = format_of(path.name)
    source = {"lod-meta.json": streamed_sog.opened, ".lod.zip": streamed_zip.opened}.get(
        "" if model_format is None else model_format.suffix
    )
    with ExitStack() as stack:
        # A pipe would keep its reader waiting.
        model = None if source is None or not path.is_file() else _leveled(path, stack, source)
        if model is None:
            stack.close()
        yield model


def _leveled(path: Path, stack: ExitStack, source: Callable[[Path], Any]) -> LeveledModel | None:
    try:
        document = stack.enter_context(source(path))
        if document.index.get("lodErrors") is not True:
            return None
        return LeveledModel(path, document.index, document.part)
    except (UnusablePicture, *streamed_sog.DAMAGE):
        return None


def leaves_of(index: Any) -> tuple[Leaves, Places]:
    """The leaves of an index, and for each level of each the number of its SOG and its first row there, int64 [leaves,
    levels, 2].

    Raises ValueError, LookupError, TypeError or AttributeError for another document, and for one in which a leaf lacks
    a level or its error.
    """
    levels = index["lodLevels"]
    if type(levels) is not int or not 0 < levels <= MOST_LEVELS:
        raise ValueError(f"it has {levels!r:.20} levels")
    rows = []
    for node in streamed_sog.leaves(index):
        lods = [node["lods"][str(level)] for level in range(levels)]
        places = [(lod["file"], lod["offset"], lod["count"]) for lod in lods]
        rows.append((node["bound"]["min"], node["bound"]["max"], node["errors"], places))
    low, high, errors, runs = (np.array(column) for column in zip(*rows, strict=True))
    shapes = [(len(rows), 3), (len(rows), 3), (len(rows), levels), (len(rows), levels, 3)]
    if [column.shape for column in (low, high, errors, runs)] != shapes or runs.dtype != np.int64:
        raise ValueError("a leaf of its tree has a box, errors or levels of another length")
    leaves = Leaves(low.astype(float), high.astype(float), errors.astype(float), runs[..., 2])
    if not all((np.abs(numbers) < LARGEST).all() for numbers in (leaves.low, leaves.high, leaves.errors)):
        raise ValueError("a leaf of its tree has a box or errors that are not finite")
    return leaves, runs[..., :2]


def _check_places(places: Places, counts: Places, sizes: Places) -> None:
    """Raise ValueError for a run that is not within its SOG, of which there are those of `sizes` rows."""
    files, firsts = places[..., 0], places[..., 1]
    if (firsts < 0).any() or (counts < 0).any() or (counts > sizes[files] - firsts).any():
        raise ValueError("a leaf of its tree has more Gaussians than the file that it names")


def _bytes(gaussians: Gaussians) -> int:
    return gaussians.count * parameter_bytes(gaussians.degree)


def _finite(gaussians: Gaussians) -> Gaussians:
    keep = gaussians.finite()
    return gaussians if bool(keep.all()) else gaussians.select(keep)

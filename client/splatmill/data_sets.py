"""Where a data set has its cameras: transforms.json files and COLMAP models among the names of files.

The rule is one for a local folder, an unpacked zip and the folder of a capture. The page has the same one
(server/splatmill_server/web/page/new/kinds.js); a test compares the two.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

MAX_DEPTH = 4
"""Folders around a data set that are looked into: zips and programs often put it into folders of their own."""

_PLACES = (
    re.compile(r"(?:^|(?<=/))sparse/(?:\d+/)?\Z", re.IGNORECASE | re.ASCII),
    re.compile(r"(?:^|(?<=/))colmap/sparse/(?:\d+/)?\Z", re.IGNORECASE | re.ASCII),
    re.compile(r"(?:^|(?<=/))\d+/\Z", re.ASCII),
)
"""Folders of a data set in which tools put COLMAP models, in order of preference; the data set's own is the last."""


class TwoDataSets(ValueError):
    """Cameras of several data sets were found, and nothing says which is meant. The message names two."""


@dataclass(frozen=True)
class Cameras:
    """The files of cameras of one data set.

    top: the folder of the data set, with a slash at its end; empty where it is the folder itself.
    transforms: names of the transforms*.json files in it.
    models: its folders with a COLMAP model, each with a slash at its end, in order of their numbers. They are
        alternatives: COLMAP writes a model for each set of photos that it could not join with the others.
    """

    top: str
    transforms: tuple[str, ...] = ()
    models: tuple[str, ...] = ()


def walk(root: Path) -> list[str]:
    """The relative names of all files under `root` except hidden ones, sorted. Raises OSError."""

    def fail(error: OSError) -> None:
        raise error

    names: list[str] = []
    visited: set[tuple[int, int]] = set()
    # Links are followed, because data sets share photos through them; a folder seen before ends a cycle.
    for folder, subfolders, files in os.walk(root, onerror=fail, followlinks=True):
        here = os.stat(folder)
        if (here.st_dev, here.st_ino) in visited:
            subfolders.clear()
            continue
        visited.add((here.st_dev, here.st_ino))
        subfolders[:] = [name for name in subfolders if not name.startswith((".", "__MACOSX"))]
        inside = Path(folder).relative_to(root)
        names += [(inside / name).as_posix() for name in files if not name.startswith(".")]
    return sorted(names)


def find_cameras(names: Sequence[str]) -> Cameras | None:
    """The cameras among files with these relative names: those of the outermost data set; None without any.

    Raises TwoDataSets where several data sets lie side by side.
    """
    transforms: dict[str, list[str]] = {}
    models: dict[str, list[tuple[int, str]]] = {}
    lower = {name.lower() for name in names}
    for name in names:
        folder, base = _split(name)
        base = base.lower()
        if base.startswith("transforms") and base.endswith(".json"):
            transforms.setdefault(folder, []).append(name)
        elif base in ("cameras.bin", "cameras.txt"):
            top, rank = _place(folder)
            # A file called cameras.txt in some folder is a model only together with its images.
            if top == "" or f"{folder.lower()}images{base[-4:]}" in lower:
                found = models.setdefault(top, [])
                if (rank, folder) not in found:
                    found.append((rank, folder))
    tops = sorted({*transforms, *models}, key=lambda top: (top.count("/"), top))
    if not tops or tops[0].count("/") > MAX_DEPTH:
        return None
    if len(tops) > 1 and tops[1].count("/") == tops[0].count("/"):
        raise TwoDataSets(
            f"There are cameras of several data sets, in {tops[0]} and in {tops[1]}. Give the folder of one of them."
        )
    top = tops[0]
    candidates = models.get(top, [])
    best = min((rank for rank, _ in candidates), default=0)
    folders = sorted((folder for rank, folder in candidates if rank == best), key=_number)
    return Cameras(top, tuple(transforms.get(top, ())), tuple(folders))


def _place(folder: str) -> tuple[str, int]:
    """The data set that a folder with a COLMAP model belongs to, and the rank of its place there."""
    # "colmap/sparse/" ends in "sparse/" too, so that the longest place is asked for first.
    for rank in (1, 0, 2):
        found = _PLACES[rank].search(folder)
        if found:
            return folder[: found.start()], rank
    return folder, len(_PLACES)


def _number(folder: str) -> tuple[bool, int, str]:
    """The order of the models of a data set: by their numbers, and one without a number behind them."""
    last = folder.rstrip("/").rpartition("/")[2]
    numbered = last.isdecimal() and last.isascii()
    return (not numbered, int(last) if numbered else 0, folder)


def _split(name: str) -> tuple[str, str]:
    """The folder of a name, with a slash at its end or empty, and the name in it."""
    head, slash, base = name.rpartition("/")
    return head + slash, base

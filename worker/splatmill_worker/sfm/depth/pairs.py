"""Which depth map, and which map of confidence, belongs to which photo: by its name, as masks do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from splatmill.data_sets import walk
from splatmill.schema.files.other_pictures import CONFIDENCE, DEPTH, kind_of_folder, without_folder
from splatmill.schema.files.photos import PHOTO_SUFFIXES
from splatmill_worker.scene import View

OF_PHOTOS = re.compile(r"(images|input|rgb|colou?r)(_\d+)?", re.ASCII | re.IGNORECASE)
"""Folders of photos, beside which those of their depth maps lie."""

_FRAME = re.compile(r"_(\d{6,})\Z", re.ASCII)
"""The end of the name of a frame of a video: its number."""


@dataclass(frozen=True)
class Maps:
    """The depth maps of a capture.

    of_view: path of the depth map and of its map of confidence, if there is one, by the index of the view.
    unpaired: names of the depth maps that belong to no photo.
    names: names of all of them and of the maps of confidence, relative to their folder.
    """

    of_view: dict[int, tuple[Path, Path | None]]
    unpaired: tuple[str, ...]
    names: frozenset[str]


def maps_of(folders: Sequence[Path], views: Sequence[View]) -> Maps:
    """The maps under some folders, by the folders that they lie in and by the views that name their own.

    The map of `images/a.jpg` is `depth/a.png`. Where several photos are called alike, their folders decide; where these
    do not, none has the map. The map of a frame of a video is called by the number of the frame.
    """
    depths: dict[str, Path] = {}
    confidences: dict[str, Path] = {}
    for folder in folders:
        for name in walk(folder) if folder.is_dir() else ():
            kind = kind_of_folder(name) if name.lower().endswith(PHOTO_SUFFIXES) else None
            if kind in (DEPTH, CONFIDENCE):
                (depths if kind == DEPTH else confidences).setdefault(name, folder / name)
    by_name = _by_last(depths)
    sure = _by_last(confidences)
    of_view: dict[int, tuple[Path, Path | None]] = {}
    for index, view in enumerate(views):
        if view.face is not None:
            continue
        depth = view.depth
        if depth is None:
            own = _of(view, by_name)
            depth = None if own is None else depths[own]
        if depth is None:
            continue
        level = _of(view, sure)
        of_view[index] = depth, None if level is None else confidences[level]
    used = {path for path, _ in of_view.values()}
    unpaired = tuple(name for name, path in depths.items() if path not in used)
    return Maps(of_view, unpaired, frozenset((*depths, *confidences)))


def _by_last(names: Sequence[str] | dict[str, Path]) -> dict[str, list[str]]:
    """Names of maps by their file name without its suffix, in lower case."""
    index: dict[str, list[str]] = {}
    for name in names:
        index.setdefault(PurePosixPath(name).stem.lower(), []).append(name)
    return index


def _of(view: View, maps: dict[str, list[str]]) -> str | None:
    """The map of a view, if it is the only one with the most of the folders of its photo."""
    photo = PurePosixPath(view.image.as_posix())
    number = _FRAME.search(photo.stem)
    named = maps.get(photo.stem.lower()) or (maps.get(number[1]) if number else None) or []
    if len(named) < 2:
        return named[0] if named else None
    folders = [part.lower() for part in photo.parts[:-1] if not OF_PHOTOS.fullmatch(part)]
    alike = [
        _common(folders, [part.lower() for part in PurePosixPath(without_folder(name)).parts[:-1]])
        for name in named
    ]
    fitting = [name for name, count in zip(named, alike, strict=True) if count == max(alike)]
    return fitting[0] if len(fitting) == 1 else None


def _common(one: list[str], other: list[str]) -> int:
    """Number of the last folders of two paths that are called alike."""
    pairs = zip(reversed(one), reversed(other), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))

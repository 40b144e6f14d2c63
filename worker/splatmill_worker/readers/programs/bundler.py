"""Cameras and points of Bundler v0.3, as Bundler, COLMAP, RealityScan, Metashape and others write them.

https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html describes the file. A camera looks along -z with y
up: P = R X + t, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p in pixels from the middle of the photo, x to the right
and y up. A list beside it has the name of the photo of each camera, in order.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.readers.programs.shots import (
    BROWN,
    FLIP,
    MOST_SHOTS,
    Float,
    NoCameras,
    Shot,
    Shots,
    numbers,
    pinhole_or,
    rotation_of,
    text_of,
)

HEADER = "# Bundle file v0.3"


def read(paths: list[Path]) -> Shots:
    """The cameras in the file among `paths` that is one of Bundler, with the names in the list among them.

    Raises NoCameras where there is no such file, and ValueError, which says what is missing.
    """
    outs = [path for path in paths if path.suffix.lower() == ".out"]
    bundle = next((path for path in outs if text_of(path).startswith("# Bundle file")), None)
    if bundle is None:
        raise NoCameras("it is no file of Bundler")
    text = text_of(bundle)
    if not text.startswith(HEADER):
        raise ValueError(f"its first line is {text.splitlines()[0][:40]!r}; version 0.3 is read, {HEADER!r}")
    lines = iter(text.splitlines()[1:])
    cameras, points = (int(value) for value in numbers(_next(lines, "the counts"), 2, "the second line"))
    if not 0 <= cameras <= MOST_SHOTS:
        raise ValueError(f"it announces {cameras} cameras; at most {MOST_SHOTS} are read")
    if not 0 <= 5 * cameras + 3 * points <= text.count("\n"):
        raise ValueError(
            f"it announces {cameras} cameras and {points} points, and has {len(text)} letters: it is cut off"
        )
    names = _names(bundle, [path for path in paths if path not in outs], cameras)
    result = Shots([])
    for index in range(cameras):
        what = f"camera {index}"
        focal, k1, k2 = numbers(_next(lines, what), 3, what)
        rotation = np.array([numbers(_next(lines, what), 3, what) for _ in range(3)])
        translation = np.array(numbers(_next(lines, what), 3, what))
        name = names[index]
        if not focal > 0.0:
            result.left_out.append((name, "Bundler has not placed it"))
            continue
        try:
            turn = FLIP @ rotation_of(rotation)
        except ValueError as error:
            result.faulty.append((name, str(error)))
            continue
        pose = np.hstack([turn, (FLIP @ translation)[:, None]])
        model, distortion = pinhole_or(BROWN, (k1, k2, 0.0, 0.0))
        result.shots.append(
            Shot(name, tuple(pose.ravel().tolist()), model, (focal, focal), (0.0, 0.0), distortion)
        )
    result.points, result.colors = _points(lines, points)
    return result


def _points(lines: Iterator[str], count: int) -> tuple[Float, npt.NDArray[np.uint8]]:
    """Positions and colours. A point has three lines: position, colour, and the photos that show it."""
    positions, colors = np.zeros((count, 3)), np.zeros((count, 3), np.uint8)
    for index in range(count):
        what = f"point {index} of {count}"
        positions[index] = numbers(_next(lines, what), 3, what)
        colors[index] = np.clip(numbers(_next(lines, what), 3, what), 0, 255)
        _next(lines, what)
    return positions, colors


def _names(bundle: Path, lists: list[Path], count: int) -> list[str]:
    """The names of the photos in the list beside a file, whose own name is the most like it.

    Raises ValueError without a list, and for one with another number of names.
    """
    stem = bundle.stem.lower().removesuffix(".bundle")
    ordered = sorted(lists, key=lambda path: (not path.name.lower().startswith(stem), path.name))
    counts: list[str] = []
    for path in ordered:
        # A line is a name, and in lists of Bundler two numbers behind it, with the focal length by EXIF.
        names = [
            _name(line) for line in text_of(path).splitlines() if line.strip() and not line.startswith("#")
        ]
        if len(names) == count:
            return names
        counts.append(f"{path.name} has {len(names)}")
    raise ValueError(
        f"{bundle.name} has {count} cameras, and the names of their photos are in a list beside it, such as "
        f"list.txt, {'which is missing' if not counts else 'and ' + ', and '.join(counts)}; give the list that was "
        "written with it"
    )


def _name(line: str) -> str:
    words = line.strip().rsplit(None, 2)
    if len(words) == 3 and words[1] == "0" and words[2].replace(".", "", 1).isdigit():
        return words[0]
    return line.strip()


def _next(lines: Iterator[str], what: str) -> str:
    for line in lines:
        if line.strip() or what.startswith("point"):
            return line
    raise ValueError(f"it ends before {what}: it is cut off")

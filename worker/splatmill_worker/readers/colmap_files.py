"""Reads the files of a COLMAP model into arrays, in a process of its own: see `images.decoding.decoders.call_once`.

COLMAP's own readers believe the counts in binary files, and allocate for them. They also keep the features of all
photos, which nothing here uses. https://colmap.github.io/format.html describes the files.
"""

from __future__ import annotations

import codecs
import mmap
import re
import struct
from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.readers import reader_memory
from splatmill_worker.wording import plain

STEMS = ("cameras", "images", "points3D")
"""Stems of the files that are read; COLMAP's rigs and frames repeat the poses of the images."""

MAX_FILE_BYTES = 2 * 2**30
"""Bytes of one file of a model."""

MAX_NAME_BYTES = 4096
"""Bytes of a photo's name."""

MAX_LINE_BYTES = 2**20
"""Bytes of a line of text that is read; the lines of features are skipped, whatever their length."""

MOST_ENTRIES = 200_000
"""Cameras, and images, of a model: some for each photo that a capture can have."""

COPIES = 12
"""Times the size of a file of points that reading it takes at most; a test measures it."""

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters of each camera model, by COLMAP's number of it; a test compares them with COLMAP's."""

MOST_PARAMETERS = max(count for _, count in MODELS.values())

Arrays = dict[str, npt.NDArray[Any]]

_NUMBERS = {name: number for number, (name, _) in MODELS.items()}
_INTEGER = re.compile(r"\d+\Z", re.ASCII)
_NUMBERS_ALONE = re.compile(r"[\s\d.+\-eEnaif]*", re.ASCII)
_MOST = 2**62  # of a size in pixels, which has 64 bits in a file
_ROWS = 2**16  # points that are gathered at a time

_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def read(folder: Path) -> Arrays:
    """The arrays of the model in `folder`, as .bin or as .txt.

    Points are missing where points3D is missing or empty.

    camera_ids [C]; camera_models [C], numbers of MODELS; camera_sizes [C,2], pixels; camera_params [C,MOST_PARAMETERS].
    image_ids, image_cameras [I]; image_poses [I,7], quaternion (wxyz) and translation; image_names, UTF-8, each with a
    zero byte behind it.
    points [N,3]; colors [N,3]; errors [N]; track_offsets [N+1]; track_images, ids of the images of one track after the
    other.

    Raises ValueError, naming the file and the entry, when a file is missing, too large or damaged.
    """
    suffix = ".bin" if _file(folder, "cameras.bin").is_file() else ".txt"
    arrays: Arrays = {}
    for stem in STEMS:
        file = _file(folder, f"{stem}{suffix}")
        size = file.stat().st_size if file.is_file() else 0
        if size > MAX_FILE_BYTES:
            raise ValueError(f"{file.name} has {size} bytes; at most {MAX_FILE_BYTES} are read.")
        if size == 0 and stem != "points3D":
            raise ValueError(
                f"{which(folder)} has no {file.name}, or an empty one. "
                "Give the files cameras and images, both as .bin or both as .txt; points3D is not required."
            )
        try:
            reader_memory.check("reading it", COPIES * size, size)
            arrays |= (
                _READERS[suffix][stem](file) if size else _points(np.zeros(0, _POINT), array("q"), array("q"))
            )
        except (struct.error, ValueError, OverflowError) as error:
            raise ValueError(f"{file.name} could not be read: {plain(error)}.") from error
    return arrays


def place(folder: Path) -> str:
    """The folder of a model as users know it: `sparse/0`, `colmap/sparse` or `0`; "" for the data set's own."""
    parts = folder.parts
    end = len(parts)
    begin = end - 1 if parts[-1:] and parts[-1].isdecimal() else end
    for name in ("sparse", "colmap"):
        if begin and parts[begin - 1].lower() == name:
            begin -= 1
        else:
            break
    return "/".join(parts[begin:end])


def which(folder: Path) -> str:
    """The model in a folder, as the subject of a sentence."""
    return f"The COLMAP model in {place(folder)}" if place(folder) else "The COLMAP model"


def _file(folder: Path, name: str) -> Path:
    """The file of this name, or else the one whose name has another case."""
    path = folder / name
    if path.is_file():
        return path
    return next((other for other in sorted(folder.iterdir()) if other.name.lower() == name.lower()), path)


def _walk(path: Path, least: int, entry: Callable[[mmap.mmap, int], int]) -> mmap.mmap:
    """Read the entries of a binary file in order, and return its bytes.

    least: bytes of the shortest entry.
    entry: reads the entry that begins at an offset and returns where it ends; it raises struct.error or ValueError.

    Raises ValueError where the file does not hold as many entries as it announces.
    """
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    count, done, at = 0, 0, 8
    try:
        (count,) = struct.unpack_from("<Q", data, 0)
        fault = "" if at + count * least <= len(data) else f"an entry has {least} bytes or more"
        while not fault and done < count:
            at = entry(data, at)
            fault = "" if at <= len(data) else "it ends before its last entry does"
            done += 1 if not fault else 0
    except (struct.error, ValueError) as error:
        fault = plain(error)
    if fault:
        raise ValueError(
            f"it announces {count} entries in {len(data)} bytes, and entry {done + 1} is damaged or missing ({fault})"
        )
    return data


def _cameras_bin(path: Path) -> Arrays:
    """id u32, model i32, width u64, height u64, and the parameters, f64, of the model."""
    cameras = _Cameras()

    def entry(data: mmap.mmap, at: int) -> int:
        number, model, width, height = _CAMERA.unpack_from(data, at)
        if model not in MODELS:
            raise ValueError(f"there is no camera model {model}; COLMAP's are {_listed()}")
        count = MODELS[model][1]
        parameters = struct.unpack_from(f"<{count}d", data, at + _CAMERA.size)
        cameras.add(number, model, width, height, parameters)
        return at + _CAMERA.size + 8 * count

    _walk(path, _CAMERA.size + 8, entry)
    return cameras.arrays()


def _images_bin(path: Path) -> Arrays:
    """id u32, pose 7 f64, camera u32, name up to a zero byte, number of points u64, and 24 bytes for each."""
    images = _Images()

    def entry(data: mmap.mmap, at: int) -> int:
        number, *pose, camera = _IMAGE.unpack_from(data, at)
        begin = at + _IMAGE.size
        end = data.find(b"\0", begin, begin + MAX_NAME_BYTES)
        if end < 0:
            raise ValueError(f"its name does not end within {MAX_NAME_BYTES} bytes")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        images.add(number, pose, camera, data[begin:end])
        return end + 9 + 24 * int(points)

    _walk(path, _IMAGE.size + 9, entry)
    return images.arrays()


def _points_bin(path: Path) -> Arrays:
    """Entries of _POINT, whose last field is the length of the track, and 8 bytes for each of its elements."""
    begins, track_lengths, track_images = array("q"), array("q"), array("q")

    def entry(data: mmap.mmap, at: int) -> int:
        (track,) = struct.unpack_from("<Q", data, at + _POINT.itemsize - 8)
        end = at + _POINT.itemsize + 8 * int(track)
        if end <= len(data):
            begins.append(at)
            track_lengths.append(track)
            elements = np.frombuffer(data, "<u4", 2 * track, at + _POINT.itemsize)
            track_images.frombytes(elements[::2].astype(np.int64).tobytes())
        return end

    data = _walk(path, _POINT.itemsize, entry)
    content = np.frombuffer(data, np.uint8)
    table = np.zeros(len(begins), _POINT)
    for first in range(0, len(begins), _ROWS):
        begin = np.array(begins[first : first + _ROWS])
        table[first : first + _ROWS] = content[begin[:, None] + np.arange(_POINT.itemsize)].view(_POINT)[:, 0]
    return _points(table, track_lengths, track_images)


def _points(table: npt.NDArray[np.void], track_lengths: array[int], track_images: array[int]) -> Arrays:
    """The arrays of points: rows of _POINT, and of all tracks one after the other the ids of their images."""
    return {
        "points": table["xyz"].astype(np.float64),
        "colors": table["color"].astype(np.uint8),
        "errors": table["error"].astype(np.float64),
        "track_offsets": np.concatenate([[0], np.cumsum(track_lengths, dtype=np.int64)]).astype(np.int64),
        "track_images": np.array(track_images),
    }


def _cameras_txt(path: Path) -> Arrays:
    """A line is id, name of the model, width, height, and parameters."""
    cameras = _Cameras()
    for _, number, model, width, height, *parameters in _lines(path, 5):
        kind = _NUMBERS.get(model)
        if kind is None:
            raise ValueError(
                f"camera {number[:40]} has the model {model[:40]!r}, which does not exist; COLMAP's are {_listed()}"
            )
        values = [float(value) for value in parameters]
        cameras.add(int(number), kind, int(width), int(height), values)
    return cameras.arrays()


def _listed() -> str:
    return ", ".join(f"{name} ({number})" for number, (name, _) in MODELS.items())


def _images_txt(path: Path) -> Arrays:
    """A line is id, pose, camera and name, which may hold spaces; a line of features follows it, or is left out."""
    images = _Images()
    for line, number, *words in _lines(path, 9, skipping=True):
        pose, camera = [float(word) for word in words[:7]], words[7]
        name = line.split(None, 9)[9].strip(" \t\r\n") if len(words) > 8 else ""
        images.add(int(number), pose, int(camera), name.encode("utf-8", "surrogateescape"))
    return images.arrays()


def _points_txt(path: Path) -> Arrays:
    """A line is id, position, colour, error, and the image and feature of each element of the track."""
    values, track_lengths, track_images = array("d"), array("q"), array("q")
    colors = bytearray()
    for _, _, x, y, z, red, green, blue, error, *track in _lines(path, 8):
        values.extend((float(x), float(y), float(z), float(error)))
        colors += bytes((int(red), int(green), int(blue)))
        track_lengths.append(len(track) // 2)
        track_images.extend(map(int, track[: len(track) // 2 * 2 : 2]))
    table = np.zeros(len(track_lengths), _POINT)
    rows = np.array(values).reshape(-1, 4)
    table["xyz"], table["error"] = rows[:, :3], rows[:, 3]
    table["color"] = np.frombuffer(colors, np.uint8).reshape(-1, 3)
    return _points(table, track_lengths, track_images)


def _lines(path: Path, least: int, *, skipping: bool = False) -> Iterator[list[str]]:
    """Each line of a text file, and its words, of which there are `least` or more; comments are left out.

    The text is UTF-8, or has a byte-order mark; lines end as on any system. Bytes that are no UTF-8 become
    surrogates.

    skipping: leave out the line of features behind each. Raises ValueError for a line with fewer words, and for a
    longer one than MAX_LINE_BYTES.
    """
    with path.open("rb") as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    encoding, errors = ("utf-16", "replace") if wide else ("utf-8-sig", "surrogateescape")
    number, due = 0, False
    with path.open(encoding=encoding, errors=errors) as lines:
        while text := lines.readline(MAX_LINE_BYTES):
            number += 1
            if due and not _names_image(text):
                due = False
                while not text.endswith("\n") and (text := lines.readline(MAX_LINE_BYTES)):
                    pass
                continue
            if len(text) == MAX_LINE_BYTES:
                raise ValueError(f"line {number} has {MAX_LINE_BYTES} bytes or more")
            words = text.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) < least:
                raise ValueError(f"line {number} has {len(words)} words, and {least} or more are needed")
            yield [text, *words]
            due = skipping


def _names_image(line: str) -> bool:
    """Whether a line is one of an image, and not of features, which are numbers alone, three for each feature."""
    words = line.split(None, 9)
    if len(words) < 10 or words[0].startswith("#"):
        return False
    return bool(
        _INTEGER.match(words[0]) and _INTEGER.match(words[8]) and not _NUMBERS_ALONE.fullmatch(words[9])
    )


class _Cameras:
    def __init__(self) -> None:
        self._rows: list[tuple[int, int, int, int]] = []
        self._parameters: list[Sequence[float]] = []

    def add(self, number: int, model: int, width: int, height: int, parameters: Sequence[float]) -> None:
        name, count = MODELS[model]
        if len(parameters) != count:
            raise ValueError(f"camera {number} has {len(parameters)} parameters, and {name} has {count}")
        if len(self._rows) >= MOST_ENTRIES:
            raise ValueError(f"it has more than {MOST_ENTRIES} cameras")
        self._rows.append((number, model, min(width, _MOST), min(height, _MOST)))
        self._parameters.append(parameters)

    def arrays(self) -> Arrays:
        rows = np.array(self._rows, np.int64).reshape(-1, 4)
        table = np.zeros((len(rows), MOST_PARAMETERS))
        for row, parameters in zip(table, self._parameters, strict=True):
            row[: len(parameters)] = parameters
        return {
            "camera_ids": rows[:, 0],
            "camera_models": rows[:, 1],
            "camera_sizes": rows[:, 2:],
            "camera_params": table,
        }


class _Images:
    def __init__(self) -> None:
        self._ids, self._cameras = array("q"), array("q")
        self._poses = array("d")
        self._names = bytearray()

    def add(self, number: int, pose: Sequence[float], camera: int, name: bytes) -> None:
        if b"\0" in name:
            raise ValueError(f"the name of image {number} has a zero byte")
        if len(self._ids) >= MOST_ENTRIES:
            raise ValueError(f"it has more than {MOST_ENTRIES} images")
        self._ids.append(number)
        self._cameras.append(camera)
        self._poses.extend(pose)
        self._names += name + b"\0"

    def arrays(self) -> Arrays:
        return {
            "image_ids": np.array(self._ids),
            "image_cameras": np.array(self._cameras),
            "image_poses": np.array(self._poses).reshape(-1, 7),
            "image_names": np.frombuffer(self._names, np.uint8),
        }


_READERS: dict[str, dict[str, Callable[[Path], Arrays]]] = {
    ".bin": {"cameras": _cameras_bin, "images": _images_bin, "points3D": _points_bin},
    ".txt": {"cameras": _cameras_txt, "images": _images_txt, "points3D": _points_txt},
}

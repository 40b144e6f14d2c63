"""Reads the files of COLMAP models, also of strangers' and without points.

COLMAP's readers believe the counts in binary files, and allocate for them. The structure of those is therefore walked
first. https://colmap.github.io/format.html describes the files.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatmill_worker.colmap import pycolmap

FILES = ("cameras", "images", "points3D")
"""Stems of the files that are read; COLMAP's rigs and frames repeat the poses of the images."""

MAX_FILE_BYTES = 2 * 2**30
"""Bytes of one file of a model."""

MAX_NAME_BYTES = 4096
"""Bytes of a photo's name."""

MAX_SIDE = 1_000_000
"""Pixels of a side of a camera."""

MAX_PARAMETER = 1e7
"""Largest parameter of a camera: a focal length or a coordinate in pixels, or a coefficient of the lens."""

MAX_DISTANCE = 1e12
"""Distance of a camera from the origin, in units of the model: squares of it are exact enough."""


def read(folder: Path) -> pycolmap.Reconstruction:
    """The model in `folder`, as .bin or as .txt; without points where points3D is missing or empty.

    Raises ValueError, naming the file or the entry, when a file is missing, too large, damaged or contradicts another,
    and when a camera or a pose is not valid.
    """
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    with tempfile.TemporaryDirectory(prefix="splatmill-model-") as place:
        for stem in FILES:
            source, target = folder / f"{stem}{suffix}", Path(place) / f"{stem}{suffix}"
            size = source.stat().st_size if source.is_file() else 0
            if size > MAX_FILE_BYTES:
                raise ValueError(f"{source.name} has {size} bytes; at most {MAX_FILE_BYTES} are read.")
            if size > 0:
                target.symlink_to(source.absolute())
            elif stem == "points3D":
                target.write_bytes(struct.pack("<Q", 0) if suffix == ".bin" else b"")
            else:
                raise ValueError(
                    f"The COLMAP model in {folder.name}/ has no {source.name}, or an empty one. "
                    "Give the files cameras and images, both as .bin or both as .txt; points3D is not required."
                )
            if size > 0 and suffix == ".bin":
                _check_structure(source, _ENTRIES[stem])
        try:
            model = pycolmap.Reconstruction(place)
        except (RuntimeError, ValueError, OSError, IndexError) as error:
            raise ValueError(
                f"The COLMAP model in {folder.name}/ could not be read: {_last_line(error)}. "
                "Give the files cameras, images and points3D, all as .bin or all as .txt."
            ) from error
    _check_values(model)
    return model


def _check_values(model: pycolmap.Reconstruction) -> None:
    """Raise ValueError for a camera or a pose with which no photo can have been taken."""
    for number, camera in model.cameras.items():
        if camera.is_spherical():
            raise ValueError(
                f"Camera {number} of the COLMAP model is spherical; photos of such cameras are not used."
            )
        focal = [camera.params[index] for index in camera.focal_length_idxs()]
        if not (np.abs(camera.params).max() <= MAX_PARAMETER and min(focal, default=1.0) > 0.0):
            raise ValueError(f"Camera {number} of the COLMAP model has the parameters {list(camera.params)}.")
        if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
            raise ValueError(
                f"Camera {number} of the COLMAP model has {camera.width} x {camera.height} pixels; a side has 1 to "
                f"{MAX_SIDE}."
            )
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world()
        if not (abs(float(np.linalg.norm(pose.rotation.quat)) - 1.0) < 1e-3):
            raise ValueError(
                f"The rotation of {image.name!r} in the COLMAP model is not valid: {pose.rotation.quat}."
            )
        if not (np.abs(pose.translation) <= MAX_DISTANCE).all():
            raise ValueError(
                f"The translation of {image.name!r} in the COLMAP model is not valid, or too large: {pose.translation}."
            )


def _check_structure(path: Path, entry: Callable[[mmap.mmap, int], int]) -> None:
    """Raise ValueError when a binary file does not hold exactly as many entries as it says.

    entry: returns where the entry ends that begins at an offset; it raises struct.error or ValueError where it cannot.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = len(data)
        count, done, at = 0, 0, 8
        try:
            (count,) = struct.unpack_from("<Q", data, 0)
            while done < count and at <= size:
                at = entry(data, at)
                done += 1
            fault = "" if at <= size else "it ends before its last entry does"
        except (struct.error, ValueError) as error:
            fault = str(error)
    if fault:
        raise ValueError(
            f"{path.name} could not be read: it announces {count} entries in {size} bytes, and entry {done + 1} is "
            f"damaged or missing ({fault})."
        )


def _camera_end(data: mmap.mmap, at: int) -> int:
    """id u32, model i32, width u64, height u64, and the parameters, f64, of the model."""
    (kind,) = struct.unpack_from("<i", data, at + 4)
    if kind not in _PARAMETERS:
        raise ValueError(f"there is no camera model {kind}")
    return at + 24 + 8 * _PARAMETERS[kind]


def _image_end(data: mmap.mmap, at: int) -> int:
    """id u32, pose 7 f64, camera u32, name up to a zero byte, number of points u64, and 24 bytes for each."""
    name = at + 64
    zero = data.find(b"\0", name, name + MAX_NAME_BYTES)
    if zero < 0:
        raise ValueError(f"its name does not end within {MAX_NAME_BYTES} bytes")
    (points,) = struct.unpack_from("<Q", data, zero + 1)
    return zero + 9 + 24 * int(points)


def _point_end(data: mmap.mmap, at: int) -> int:
    """id u64, position 3 f64, colour 3 u8, error f64, length of the track u64, and 8 bytes for each of its elements."""
    (track,) = struct.unpack_from("<Q", data, at + 43)
    return at + 51 + 8 * int(track)


_ENTRIES = {"cameras": _camera_end, "images": _image_end, "points3D": _point_end}

_PARAMETERS = {
    int(kind.value): len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)
    for kind in pycolmap.CameraModelId.__members__.values()
    if kind.name != "INVALID"
}
"""Number of parameters of each camera model, by COLMAP's number of it."""


def _last_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1][:200]

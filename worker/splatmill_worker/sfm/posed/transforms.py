"""Scenes from transforms.json of nerfstudio and instant-ngp, transforms_{train,test}.json of Blender data sets, and the
raw data of Polycam.

All hold camera-to-world matrices with OpenGL axes (x right, y up, z backward).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from splatmill.data_sets import keyframes
from splatmill.schema.files.names import readings
from splatmill.schema.quantities import format_bytes, listed
from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Refusal, UnusablePicture
from splatmill_worker.images.archives.zip_names import ENCODINGS
from splatmill_worker.images.decoding import decoders
from splatmill_worker.readers import point_file
from splatmill_worker.scene import Scene, Source, View, viewmat_of
from splatmill_worker.sfm.posed import parts, polycam
from splatmill_worker.sfm.posed.camera_models import UnreadModel, check_pixels, kind_of, panorama, radians
from splatmill_worker.sfm.posed.colmap_model import camera_and_lens, fit_to_file
from splatmill_worker.sfm.posed.encodings import NamesUnclear, chosen, not_utf8
from splatmill_worker.sfm.posed.files import ImageFiles, alternatives, instead, missing, none_usable
from splatmill_worker.sfm.posed.model_files import MAX_DISTANCE, MAX_PARAMETER, MAX_SIDE, MOST_FAULTY
from splatmill_worker.sfm.posed.one_camera import one_for_each
from splatmill_worker.sfm.posed.parts import Part
from splatmill_worker.wording import plain

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns the axes of a camera-to-world matrix from OpenGL's to OpenCV's."""

MAX_SHEAR = 1e-2
"""Largest element of R^T R - 1, for the rotation part R with its scale taken out, that counts as rounding."""

MIN_DETERMINANT = 1e-12
"""Determinant of the rotation part up to which a matrix counts as singular or mirrored."""


DEPTHS = "depth_file_path", "depth_path"
"""The fields of a frame that name its depth map, of nerfstudio and of instant-ngp."""

DEPTH_UNITS = "depth_unit_scale_factor", "integer_depth_scale"
"""The fields of a document with the length of one of its levels, of the same programs."""

MAX_FILE_BYTES = 32 * 2**20
"""Bytes of a transforms file: 35,000 frames and more."""

MAX_PARSED_BYTES = 200 * 2**20
"""Bytes that a transforms file may take once it is parsed."""


def load(
    paths: tuple[Path, ...], source: Source, files: ImageFiles, capture: Path, notes: tuple[str, ...] = ()
) -> Scene:
    """The scene of the cameras in all `paths`, divided as these say (`parts`).

    The files are uploads of strangers: points and masks that they name are read only when they lie in `capture`.
    Raises ValueError, naming the file and the frame, for an invalid camera and for photos with different cameras, and
    when no photo is among `files`.
    """
    all_views: dict[int, View] = {}
    where: dict[int, str] = {}
    named: dict[Path, set[Part]] = {}
    left_out: list[tuple[str, str]] = []
    unusable: dict[str, str] = {}
    messages = list(notes)
    warnings: list[str] = []
    points = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    unit: float | None = None
    for path, document, said in _documents(paths, files):
        warnings += said
        if path.is_dir():
            polycam.check_photos(path, files.photos)
        unit = _depth_unit(document) or unit
        part = parts.of_file(path)
        if part == "val":
            for frame in document["frames"]:
                if photo := _photo(frame, files):
                    named.setdefault(photo, set()).add(part)
            continue
        listed_in = parts.of_lists(path, document)
        warnings += parts.unknown(path, listed_in, document["frames"])
        without = 0
        unmasked: list[str] = []
        faults: list[ValueError] = []
        for index, frame in enumerate(document["frames"]):
            if _has_no_pose(frame):
                without += 1
                left_out.append((_called(index, frame, files), f"{path.name} has no transform_matrix for it"))
                continue
            try:
                name, view = _view(path, index, document, frame, files, capture)
            except UnusablePicture as error:
                unusable[error.facts["file"]] = error.reason
                continue
            except ValueError as error:
                faults.append(error)
                if len(faults) > MOST_FAULTY * len(document["frames"]):
                    raise faults[0] from None
                left_out.append((_called(index, frame, files), str(error)))
                continue
            if view is None:
                left_out.append((name, missing(name, files, f"{path.name} has a camera for it")))
                continue
            where[len(all_views)] = f"frame {index} of {path.name}"
            all_views[len(all_views)] = view
            if view.mask is None and frame.get("mask_path"):
                unmasked.append(str(frame["mask_path"]))
            own = {part} if part else listed_in.get(parts.plain(name), set())
            named.setdefault(view.image, set()).update(own)
        if without == len(document["frames"]) > 0:
            raise ValueError(f"No frame of {path.name} has a transform_matrix: it places no photo.")
        if without:
            warnings.append(
                f"Frames without a transform_matrix are left out: {without} of {len(document['frames'])} in "
                f"{path.name}."
            )
        if unmasked:
            warnings.append(
                f"Masks that {path.name} names are not in the capture, so that these photos have none: "
                f"{len(unmasked)}, such as {unmasked[0]}."
            )
        if document.get("ply_file_path"):
            points, note = _sparse_points(path.parent, str(document["ply_file_path"]), capture)
            warnings += [note] if note else []
    distinct, contradictory = one_for_each(all_views, where.__getitem__)
    left_out += contradictory
    views, validation, remarks = parts.divided(distinct.values(), named)
    left_out += [(name, parts.NOT_USED) for name in validation]
    warnings += remarks
    if not views and unusable:
        raise none_usable(list(unusable.items()))
    if not views and not left_out:
        raise ValueError(f"{listed([path.name for path in paths])} has no frames: it places no photo.")
    if not views:
        first = f" (such as {left_out[0][0]!r})" if left_out else ""
        several = alternatives(left_out[0][0], files) if left_out else ""
        raise ValueError(
            f"{listed([path.name for path in paths])} has {len(left_out)} cameras{first}, and the capture has "
            + (
                f"several photos of this name: {several}."
                if several
                else f"none of their photos{instead(files)}."
            )
            + " Give the photos the names in file_path."
        )
    used = {view.image for view in views}
    names = {view.name for view in views}
    left_out = [(name, reason) for name, reason in (*left_out, *unusable.items()) if name not in names]
    mentioned = {name for name, _ in left_out}
    copies, copy_warnings = files.copies(used)
    left_out += [
        (name, parts.NOT_USED if named.get(path) == {"val"} else "no camera is given for it")
        for name, path in files.photos.items()
        if path not in used and path not in copies and name not in mentioned
    ]
    return Scene(
        views=tuple(sorted(views, key=lambda view: view.name)),
        points=points[0],
        colors=points[1],
        source=source,
        left_out=tuple(left_out),
        notes=tuple(messages),
        warnings=(*warnings, *copy_warnings),
        depth_unit=unit,
    )


def _documents(
    paths: Sequence[Path], files: ImageFiles
) -> Iterator[tuple[Path, dict[str, Any], tuple[str, ...]]]:
    """Each transforms document with its path, and sentences on how it was read; the files of Polycam are one document,
    with the path of their folder."""
    if all(keyframes(f"{path.parent.as_posix()}/") for path in paths):
        yield paths[0].parent, polycam.document(paths, lambda path: _parsed(path, files)[0]), ()
        return
    for path in paths:
        document, said = _parsed(path, files)
        if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
            raise ValueError(
                f"{path.name} has no list `frames`. Give a transforms file with one entry in `frames` per photo."
            )
        yield path, document, said


def _parsed(path: Path, files: ImageFiles) -> tuple[Any, tuple[str, ...]]:
    """The value in a JSON file, and sentences on how its text was read where it is not UTF-8 (or UTF-16 or UTF-32)."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ValueError(f"{path.name} has {size} bytes; at most {MAX_FILE_BYTES} are read.")
    try:
        text = path.read_bytes()
        if parsed_bytes(text) > MAX_PARSED_BYTES:
            raise ValueError(f"its lists and objects would take {format_bytes(parsed_bytes(text))} of memory")
        try:
            return json.loads(text), ()
        except UnicodeDecodeError:
            if (document := _with_stored_names(text, files)) is not None:
                return document, ()
            names: dict[str, dict[int, str]] = {}
            for encoding in ENCODINGS:
                # The text is decoded before it is parsed: in some encodings, a letter has the byte of a backslash.
                with suppress(ValueError):
                    names[encoding] = _file_paths(json.loads(text.decode(encoding)))
            best, said = chosen(names, files, path.name)
            return json.loads(text.decode(best or "utf-8", "replace")), said
    except NamesUnclear:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path.name} is not readable JSON: {plain(error)}.") from error


def _with_stored_names(text: bytes, files: ImageFiles) -> Any:
    """The value in a JSON text whose names have the same bytes as those of the photos; None where none has."""
    with suppress(ValueError):
        paths = _file_paths(json.loads(text.decode("utf-8", "surrogateescape")))
        stored = {
            index: match[0]
            for index, path in paths.items()
            if not_utf8(path) and (match := files.photo(path)) is not None
        }
        if stored:
            document = json.loads(text.decode("utf-8", "replace"))
            for index, name in stored.items():
                document["frames"][index]["file_path"] = name
            return document
    return None


def _file_paths(document: Any) -> dict[int, str]:
    """The file_path of each frame of a document that has one, by the frame's number."""
    frames = document.get("frames") if isinstance(document, dict) else None
    return {
        index: frame["file_path"]
        for index, frame in enumerate(frames if isinstance(frames, list) else ())
        if isinstance(frame, dict) and isinstance(frame.get("file_path"), str)
    }


def parsed_bytes(text: bytes) -> int:
    """Bytes that a JSON text takes once it is parsed, at most: 88 a list or object, and 40 for what follows a comma."""
    return 2 * len(text) + 88 * (text.count(b"[") + text.count(b"{")) + 40 * text.count(b",")


def _view(
    path: Path, index: int, document: dict[str, Any], frame: Any, files: ImageFiles, capture: Path
) -> tuple[str, View | None]:
    """The file_path of a frame, and its view; None when the capture has no such photo."""
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise ValueError(
            f"Frame {index} of {path.name} has no file_path; each frame needs the name of its photo."
        )
    name = frame["file_path"]
    match = files.photo(name)
    if match is None:
        return name, None
    relative, photo = match
    values = {**document, **frame}
    try:
        viewmat = world_to_camera(_matrix(frame["transform_matrix"]))
        cameras = [_colmap_camera(values, size) for size in _sizes(values, relative, photo)]
    except UnreadModel as error:
        raise UnreadModel(f"Frame {index} of {path.name} ({name}): {error}.", error.advice) from error
    except (ValueError, ArithmeticError) as error:
        raise ValueError(f"Frame {index} of {path.name} ({name}): {plain(error)}.") from error
    mask = files.mask(relative)
    if mask is None and isinstance(frame.get("mask_path"), str):
        mask = _named_mask(path, frame["mask_path"], files, capture)
    view, *other = [
        fit_to_file(camera_and_lens(camera, viewmat), relative, photo, mask) for camera in cameras
    ]
    depth = next((frame[key] for key in DEPTHS if isinstance(frame.get(key), str)), None)
    if depth is not None:
        view = replace(view, depth=_file(path.parent, depth, capture))
    return name, replace(view, other=other[0]) if other else view


def _depth_unit(document: dict[str, Any]) -> float | None:
    """Length in the world of one level of the depth maps of a document; None where it names none."""
    for key in DEPTH_UNITS:
        with suppress(ValueError):
            unit = _number(document, key)
            if unit is not None and math.isfinite(unit) and unit > 0.0:
                return unit
    named = any(isinstance(frame, dict) and frame.get(DEPTHS[0]) for frame in document["frames"])
    return polycam.DEPTH_UNIT if named else None


def _named_mask(path: Path, name: str, files: ImageFiles, capture: Path) -> Path | None:
    """The mask that a frame of the file `path` names; None where the capture has none."""
    beside = _file(path.parent, name, capture)
    return beside if beside is not None else files.named_mask(name)


def _has_no_pose(frame: Any) -> bool:
    """Whether a frame places no photo: it is null, or its matrix is missing, null or empty."""
    return frame is None or (isinstance(frame, dict) and frame.get("transform_matrix") in (None, []))


def _photo(frame: Any, files: ImageFiles) -> Path | None:
    """The photo of a frame, if it names one of the capture."""
    name = frame.get("file_path") if isinstance(frame, dict) else None
    match = files.photo(name) if isinstance(name, str) else None
    return None if match is None else match[1]


def _called(index: int, frame: Any, files: ImageFiles) -> str:
    """The name of the photo of a frame, or else its file_path, or its number where it has none."""
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str):
        return f"frame {index}"
    match = files.photo(name)
    return name if match is None else match[0]


def _file(folder: Path, name: str, capture: Path) -> Path | None:
    """The file in the capture that a transforms file in `folder` names; None where there is none."""
    paths = (folder / path for path in readings(name))
    return next((path for path in paths if _within(path, capture) and path.is_file()), None)


def world_to_camera(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The OpenCV world-to-camera matrix [4,4] of an OpenGL camera-to-world matrix [4,4] or [3,4].

    A uniform scale of the rotation part is taken out. Raises ValueError for a matrix that is not finite, is singular or
    mirrored, transposed, or shears.
    """
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix has the shape {matrix.shape}; it must be 4 x 4 or 3 x 4")
    if not np.isfinite(matrix).all():
        raise ValueError("transform_matrix has values that are not finite")
    if not np.abs(matrix).max() <= MAX_DISTANCE:
        raise ValueError(f"transform_matrix has values above {MAX_DISTANCE:.0e}")
    if matrix.shape == (4, 4) and np.abs(matrix[3, :3]).max() > MAX_SHEAR * max(1.0, abs(matrix[3, 3])):
        raise ValueError(
            f"the fourth row of transform_matrix is {', '.join(f'{value:.4g}' for value in matrix[3])}; it must be "
            "0, 0, 0, 1. The matrix is probably transposed: its fourth column is the place of the camera"
        )
    rotation = matrix[:3, :3]
    determinant = float(np.linalg.det(rotation))
    if not determinant > MIN_DETERMINANT:
        raise ValueError(
            f"the rotation part of transform_matrix has the determinant {determinant:.3g}; it must be positive, "
            "and is 1 for a rotation"
        )
    rotation = rotation / np.cbrt(determinant)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > MAX_SHEAR:
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        cosines = (matrix[:3, :3] / lengths).T @ (matrix[:3, :3] / lengths)
        angles = np.degrees(np.arccos(np.clip([cosines[0, 1], cosines[1, 2], cosines[0, 2]], -1.0, 1.0)))
        raise ValueError(
            "transform_matrix is not a rigid motion. Its axes x, y and z are "
            f"{', '.join(f'{length:.3g}' for length in lengths)} long and at "
            f"{', '.join(f'{angle:.0f}' for angle in angles)} degrees to one another (xy, yz, xz); those of a camera "
            "are equally long and at 90 degrees. Export it without scaling or shearing of single axes"
        )
    u, _, v = np.linalg.svd(rotation)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = u @ v
    camera_to_world[:3, 3] = matrix[:3, 3]
    camera_to_world = camera_to_world @ OPENGL_TO_OPENCV
    return viewmat_of(camera_to_world[:3, :3].T, camera_to_world[:3, 3])


def _sizes(values: dict[str, Any], name: str, photo: Path) -> list[tuple[int, int]]:
    """Width and height of the camera of a frame; where w or h is missing those of the file, stored and upright."""
    width, height = (_either(values, *keys) for keys in (("w", "width"), ("h", "height")))
    if width is not None and height is not None:
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise ValueError(f"w and h are {width:g} and {height:g} pixels; they must be 1 to {MAX_SIDE}")
        return [(int(width), int(height))]
    stored, upright, _ = decoders.sizes(photo, name)
    return [stored] if stored == upright else [stored, upright]


@overload
def _number(values: dict[str, Any], key: str) -> float | None: ...
@overload
def _number(values: dict[str, Any], key: str, default: float) -> float: ...
def _number(values: dict[str, Any], key: str, default: float | None = None) -> float | None:
    """The number in a field; the default where it is missing or null. Raises ValueError for anything else."""
    value = values.get(key)
    if value is None:
        return default
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{key} is {str(value)[:40]!r}, which is no number of usual size") from None


def _either(values: dict[str, Any], key: str, other: str) -> float | None:
    """The number in one of two fields that mean the same. Raises ValueError where both have one and these differ."""
    value, same = _number(values, key), _number(values, other)
    if value is not None and same is not None and value != same:
        raise ValueError(
            f"{key} is {value:g} and {other} is {same:g}, which mean the same; leave the wrong one out"
        )
    return same if value is None else value


def _matrix(rows: Any) -> npt.NDArray[np.float64]:
    try:
        return np.array(rows, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("transform_matrix has other values than 4 x 4 or 3 x 4 numbers") from None


def _colmap_camera(values: dict[str, Any], size: tuple[int, int]) -> pycolmap.Camera:
    """The camera of a frame, for a photo of this width and height."""
    width, height = size
    kind = kind_of(values)
    if kind == "panorama":
        return panorama(width, height)

    def focal(length: str, other: str, angle: str, side: int) -> float | None:
        pixels, opening = _either(values, length, other), _number(values, angle)
        return (
            pixels
            if pixels is not None or opening is None
            else 0.5 * side / math.tan(0.5 * radians(angle, opening))
        )

    horizontal = focal("fl_x", "fx", "camera_angle_x", width)
    vertical = focal("fl_y", "fy", "camera_angle_y", height)
    fx, fy = (horizontal, vertical) if horizontal and vertical else (horizontal or vertical or 0.0,) * 2
    if horizontal is None and vertical is None:
        raise ValueError("it has no focal length; give fl_x or camera_angle_x")
    cx, cy = _number(values, "cx", 0.5 * width), _number(values, "cy", 0.5 * height)
    radial = [_number(values, f"k{order}", 0.0) for order in range(1, 7)]
    tangential = [_number(values, key, 0.0) for key in ("p1", "p2")]
    largest = float(np.abs([fx, fy, cx, cy, *radial, *tangential]).max())
    if not (fx > 0 and fy > 0 and largest <= MAX_PARAMETER):
        raise ValueError(
            f"the focal lengths are {fx} and {fy} pixels; they must be positive, and all intrinsics at most "
            f"{MAX_PARAMETER:.0e}"
        )
    if kind == "fisheye":
        model, extra = "OPENCV_FISHEYE", radial[:4]
    elif any(radial[2:]):
        model, extra = "FULL_OPENCV", [*radial[:2], *tangential, *radial[2:]]
    else:
        model, extra = "OPENCV", [*radial[:2], *tangential]
    camera = pycolmap.Camera(model=model, width=width, height=height, params=[fx, fy, cx, cy, *extra])
    check_pixels(camera)
    return camera


def _within(path: Path, capture: Path) -> bool:
    """Whether a path lies in the capture's folder once symbolic links are resolved."""
    try:
        return path.resolve().is_relative_to(capture.resolve())
    except (OSError, ValueError):  # a name that no file can have
        return False


def _sparse_points(
    folder: Path, name: str, capture: Path
) -> tuple[tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]], str | None]:
    """Positions and colours of nerfstudio's sparse .ply in the world of the transforms; a note when it is unusable."""
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    written = PurePosixPath(readings(name)[0]).name
    if not any(_within(folder / path, capture) for path in readings(name)):
        return nothing, f"The points in {written} are not used: ply_file_path lies outside the capture."
    path = _file(folder, name, capture)
    if path is None:
        return (
            nothing,
            f"The points in {written}, which ply_file_path names, are not used: there is no such file.",
        )
    try:
        cloud = decoders.call_once(point_file.read, path, check=_points_of, fault=_points_fault)
    except (OSError, ValueError) as error:
        return nothing, f"The points in {path.name} are not used: {plain(error)}."
    return cloud, None


def _points_of(answer: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    """The positions and colours that `point_file.read` returns. Raises ValueError for anything else."""
    points, colors = answer
    if not (points.shape == colors.shape == (len(points), 3) and colors.dtype == np.uint8):
        raise ValueError("they are no points with colours")
    if not (points.dtype == np.float64 and np.isfinite(points).all()):
        raise ValueError("a position is no finite float64")
    return points, colors


def _points_fault(code: str, name: str, reason: str) -> Exception:
    if code != "decoder_ended":
        return ValueError(reason)
    message = f"The points in {name} could not be read: {reason}."
    return Refusal(code, message, advice="Restart the job, or remove ply_file_path from the data set.")

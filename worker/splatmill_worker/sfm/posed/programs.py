"""Scenes with the cameras of Metashape, RealityScan, Bundler and OpenSfM, as these programs write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from splatmill.data_sets import LISTS, fits
from splatmill.schema.quantities import listed
from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Refusal
from splatmill_worker.images.decoding import decoders
from splatmill_worker.readers.programs import reading
from splatmill_worker.readers.programs.reading import Kind
from splatmill_worker.readers.programs.shots import Shot
from splatmill_worker.scene import Scene
from splatmill_worker.sfm.posed import colmap_model
from splatmill_worker.sfm.posed.camera_models import IntrinsicsNotInPixels, check_pixels
from splatmill_worker.sfm.posed.files import ImageFiles
from splatmill_worker.sfm.posed.model_files import (
    MAX_DISTANCE,
    MAX_PARAMETER,
    MAX_SIDE,
    MOST_FAULTY,
    GivenImage,
    GivenModel,
    ModelPoints,
)

LONGEST_FOCAL = 50.0
"""Focal length over the longest side, above which it is in another unit: a lens of 1800 mm on a film of 36 mm."""

_SHOTS = TypeAdapter(list[Shot])
_PAIRS: TypeAdapter[list[tuple[str, str]]] = TypeAdapter(list[tuple[str, str]])
_SENTENCES: TypeAdapter[list[str]] = TypeAdapter(list[str])


class TwoFiles(ValueError):
    """Two files have cameras of one program, and nothing says which is meant. The message names both."""


@dataclass(frozen=True)
class ProgramCameras:
    """The files with cameras of one program.

    kind: what they are.
    paths: the first is the file itself, or one of many.
    unused: sentences about files of others.
    """

    kind: Kind
    paths: tuple[Path, ...]
    unused: tuple[str, ...] = ()


def find(base: Path, names: Sequence[str]) -> ProgramCameras | None:
    """The cameras in the files with these names under `base`; None where none of them has any.

    Raises TwoFiles where two files of one kind lie equally deep.
    """
    by_program: dict[str, list[str]] = {}
    for name in names:
        own = reading.kind_of(base / name)
        if own is not None:
            by_program.setdefault(own.program, []).append(name)
    kind = next((kind for kind in reading.KINDS if kind.program in by_program), None)
    if kind is None:
        return None
    files = sorted(by_program.pop(kind.program), key=lambda name: (name.count("/"), name))
    if not kind.many:
        if len(files) > 1 and files[1].count("/") == files[0].count("/"):
            raise TwoFiles(
                f"Cameras of {kind.program} are in {files[0]} and in {files[1]}. Leave one of them out."
            )
        if files[1:]:
            by_program[kind.program] = files[1:]
        files = [files[0], *(name for name in names if kind.program == "Bundler" and fits(name, LISTS))]
    unused = (
        f"The cameras of {program} in {listed(rest)} are not used, but those in {files[0]}."
        for program, rest in by_program.items()
    )
    return ProgramCameras(kind, tuple(base / name for name in files), tuple(unused))


def unrecognised(base: Path, names: Sequence[str]) -> list[str]:
    """A sentence about files with such names as other programs give to cameras, and without any; none without them."""
    lacking = [name for name in names if not fits(name, LISTS) and reading.kind_of(base / name) is None]
    if not lacking:
        return []
    known = ", ".join(dict.fromkeys(kind.program.removesuffix(" (XMP)") for kind in reading.KINDS))
    return [f"No cameras of a program that is known ({known}) are in {listed(lacking, 1)}."]


def load(cameras: ProgramCameras, files: ImageFiles, notes: tuple[str, ...] = ()) -> Scene:
    """The scene of the cameras, with its photos among `files`.

    Raises ValueError, naming the file, for one that is damaged, and where none of its photos is among the files.
    """
    first, *others = cameras.paths
    which = f"the file {first.name} of {cameras.kind.program}"

    def fault(code: str, name: str, reason: str) -> Exception:
        if code != "decoder_ended":
            return ValueError(reason)
        return Refusal(
            code, f"{first.name} could not be read: {reason}.", advice="Restart the job, or remove the file."
        )

    try:
        answer = decoders.call_once(reading.read, first, tuple(map(str, others)), check=_checked, fault=fault)
    except ValueError as error:
        raise ValueError(f"T{which[1:]} could not be read: {error}.") from error
    shots, faulty = answer["shots"], answer["faulty"]
    for shot in shots:
        if not np.abs(shot.pose).max() <= MAX_DISTANCE:
            faulty.append((shot.name, f"it is more than {MAX_DISTANCE:.0e} units away"))
    if len(faulty) > MOST_FAULTY * (len(shots) + len(faulty)):
        name, reason = faulty[0]
        raise ValueError(f"T{which[1:]} cannot be used: of {name}, {reason}.")
    wrong = {name for name, _ in faulty}
    images = {
        index: GivenImage(shot.name, _camera(shot, which), _viewmat(shot))
        for index, shot in enumerate(shots)
        if shot.name not in wrong
    }
    count = len(answer["points"])
    points = ModelPoints(
        answer["points"],
        answer["colors"],
        np.zeros(count),
        np.zeros(count + 1, np.int64),
        np.zeros(0, np.int64),
    )
    left_out = tuple(answer["left_out"]) + tuple((name, f"of {which}, {reason}") for name, reason in faulty)
    model = GivenModel(images, points, left_out, which)
    scene = colmap_model.scene_of_given(model, files, (*notes, *answer["notes"]), source="program")
    return replace(scene, warnings=(*scene.warnings, *answer["warnings"], *cameras.unused))


def _viewmat(shot: Shot) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.vstack([np.reshape(shot.pose, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _checked(answer: Any) -> dict[str, Any]:
    """What `reading.read` returns, with its shots as such. Raises ValueError for anything else."""
    points, colors = answer["points"], answer["colors"]
    if not (points.shape == colors.shape == (len(points), 3) and colors.dtype == np.uint8):
        raise ValueError("they are no points with colours")
    shots = _SHOTS.validate_python(answer["shots"])
    if any(len(shot.pose) != 12 for shot in shots):
        raise ValueError("a pose has 12 numbers")
    return {
        "shots": shots,
        "left_out": _PAIRS.validate_python(answer["left_out"]),
        "faulty": _PAIRS.validate_python(answer["faulty"]),
        "notes": _SENTENCES.validate_python(answer["notes"]),
        "warnings": _SENTENCES.validate_python(answer["warnings"]),
        "points": points.astype(np.float64),
        "colors": colors,
    }


def _camera(shot: Shot, which: str) -> pycolmap.Camera | Callable[[int, int], pycolmap.Camera]:
    """The camera of a shot, or a function of the size of the photo where the file does not have it."""

    def sized(width: int, height: int) -> pycolmap.Camera:
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise ValueError(
                f"{shot.name} has {width} x {height} pixels in {which}; a side has 1 to {MAX_SIDE}."
            )
        if shot.relative and max(shot.focal) > LONGEST_FOCAL:
            raise ValueError(
                f"The focal length of {shot.name} in {which} is {max(shot.focal):.4g} times the longest side of the "
                "photo. It is given relative to that side, or for a film of 36 mm; if it is in pixels, divide it by "
                f"{max(width, height)}, or by that and multiply it by 36."
            )
        unit = float(max(width, height)) if shot.relative else 1.0
        fx, fy = (value * unit for value in shot.focal)
        cx, cy = (0.5 * side + value * unit for side, value in zip((width, height), shot.offset, strict=True))
        params = [fx, fy, cx, cy, *shot.distortion]
        if not (np.abs(params).max() <= MAX_PARAMETER and min(fx, fy) > 0.0):
            raise ValueError(f"{shot.name} has parameters in {which} that no camera has: {params}.")
        camera = pycolmap.Camera(model=shot.model, width=width, height=height, params=params)
        try:
            check_pixels(camera)
        except IntrinsicsNotInPixels as error:
            raise IntrinsicsNotInPixels(f"Of {shot.name} in {which}, {error}.") from error
        return camera

    return sized if shot.size is None else sized(*shot.size)

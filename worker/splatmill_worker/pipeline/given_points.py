"""Points that a training starts from, of a file of a laser scanner or a depth camera, where the photos show them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema import TrainOptions
from splatmill.schema.files.formats import is_point_file
from splatmill_worker.errors import Refusal
from splatmill_worker.images.decoding import decoders
from splatmill_worker.pipeline import scan_fit
from splatmill_worker.readers import scan
from splatmill_worker.scene import Scene
from splatmill_worker.sfm.alignment import LIBRARY
from splatmill_worker.sfm.callbacks import OnProgress
from splatmill_worker.sfm.world.frame import in_metres
from splatmill_worker.wording import plain

HEADER_BYTES = 65_536
"""Bytes at the beginning of a .ply in which its properties are named."""

GAUSSIANS = (b" opacity", b" packed_position", b" scale_0")
"""What the header of a .ply names where it holds a model, and not points."""


def start_path(capture: Path, options: TrainOptions) -> Path | None:
    """The path of the file among the poses of a capture that `start` names; None where it names none.

    Raises Refusal when the capture has no such file.
    """
    if options.start_file is None:
        return None
    for folder in (capture / "poses", capture):
        if (folder / options.start_file).is_file():
            return folder / options.start_file
    raise Refusal(
        "start_unusable",
        f"There is no file {options.start_file!r} among the poses of the capture.",
        advice="Upload the file to the poses of the capture, or leave out the option start.",
    )


def points_path(capture: Path, options: TrainOptions) -> Path | None:
    """The path of the file of points to start from; None where `start` names a model or nothing.

    Raises Refusal as `start_path` does.
    """
    path = start_path(capture, options)
    if path is None or is_point_file(path.name):
        return path
    if path.suffix.lower() != ".ply" or path.name.lower().endswith(".compressed.ply"):
        return None
    with path.open("rb") as file:
        header, end, _ = file.read(HEADER_BYTES).partition(b"end_header")
    return path if end and not any(name in header for name in GAUSSIANS) else None


def with_given_points(
    scene: Scene, path: Path, options: TrainOptions, on_progress: OnProgress, cancelled: Callable[[], bool]
) -> Scene:
    """The scene with those points of a file that its photos show, beside its own: a scan has holes, and no sky.

    Where the cameras were given, the points may lie in their coordinates. Otherwise they are aligned to the points of
    the scene. A scene of an arbitrary unit is then in metres, if those of the file are.

    Raises Refusal for a file that cannot be read or has no points, for a format whose library is not installed, and
    where the photos do not show the points; and Cancelled.
    """
    if (module := scan.lacking(path)) is not None:
        raise _lacking(path.name, module, "cannot be read", ", or give the points as .ply or .xyz")
    points, colors, count = _read(path)
    fit = None
    if scene.source != "sfm":
        fit = scan_fit.as_it_lies(scene, points, colors, options.image_size, cancelled)
    if fit is None or not fit.fits:
        if find_spec(LIBRARY) is None:
            raise _lacking(path.name, LIBRARY, "cannot be aligned to the photos", "")
        where = "" if fit is None else f"As they lie: {fit.sentence} "
        fit = scan_fit.aligned(
            scene, points, colors, options.image_size, options.seed, on_progress, cancelled
        )
        if not fit.fits:
            raise Refusal(
                "start_unusable",
                f"The points of {path.name} do not fit the photos. {where}{fit.sentence}",
                advice="Give a scan with colours of what the photos show, or points in the coordinates of "
                "given cameras; or leave out the option start.",
            )
    facts: dict[str, Any] = {
        "given_points": count,
        "given_points_resolved": fit.resolved,
        "given_points_used": len(fit.points),
        "sparse_points": scene.facts.get("sparse_points", len(scene.points)),
    }
    notes = [
        f"{path.name} holds {count:,} points. One for each cell of {fit.pixels:.1f} pixels of the closest photo leaves "
        f"{fit.resolved:,}, of which {len(fit.points):,} are used: photos show their colours."
    ]
    if fit.alignment is not None:
        facts["given_points_alignment"] = asdict(fit.alignment)
        notes.append(
            f"{path.name} was aligned to the photos: {fit.sentence} One of its units is {fit.alignment.scale:.4g} of "
            "the model."
        )
    scene = replace(scan_fit.joined(scene, fit), notes=(*scene.notes, *notes), facts=scene.facts | facts)
    return _in_metres(scene, path, fit.alignment)


def _in_metres(scene: Scene, path: Path, alignment: scan_fit.Alignment | None) -> Scene:
    """The scene with the metre as its unit, where that was arbitrary and the file's is the metre by its standard."""
    if scene.frame is None or alignment is None or scene.frame.unit != "arbitrary":
        return scene
    if path.suffix.lower() not in scan.IN_METRES:
        return scene
    before = scene.frame.reasons.get("unit")
    reason = f"Metres, because those of {path.name} are."
    resized = in_metres(scene, 1.0 / alignment.scale, reason)
    matrix = np.array(alignment.matrix)
    matrix[:3] /= alignment.scale
    told = asdict(replace(alignment, scale=1.0, matrix=matrix.tolist()))
    return replace(
        resized,
        notes=tuple(reason if note == before else note for note in resized.notes),
        facts=resized.facts | {"given_points_alignment": told},
    )


def _read(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    """Finite points and colours of a file, one or more, and their number in the file. Raises Refusal, and Cancelled."""
    try:
        points, colors, count = decoders.call_once(scan.read, path, check=_points, fault=_fault)
    except OSError as error:
        raise _unusable(f"{path.name} cannot be opened: {error.strerror or error}.") from error
    except ValueError as error:
        raise _unusable(f"The points in {path.name} cannot be read: {plain(error)}.") from error
    if not len(points):
        raise _unusable(f"{path.name} holds no point with finite coordinates.")
    return points, colors, count


def _lacking(name: str, module: str, what: str, otherwise: str) -> Refusal:
    return Refusal(
        "start_unusable",
        f"{name} {what} on this worker: the Python module {module} is not installed.",
        advice=f"Install it with pip install 'splatmill-worker[scans]'{otherwise}.",
    )


def _unusable(message: str) -> Refusal:
    return Refusal(
        "start_unusable",
        message,
        advice="Export the points again, as .laz, .e57, .pcd, .ply or .xyz, or leave out the option start.",
    )


def _points(answer: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    """What `scan.read` returns. Raises ValueError for anything else."""
    points, colors, count = answer
    if not (points.shape == colors.shape == (len(points), 3) and colors.dtype == np.uint8):
        raise ValueError("they are no points with colours")
    if not (points.dtype == np.float64 and np.isfinite(points).all() and count >= len(points)):
        raise ValueError("a position is no finite float64")
    return points, colors, int(count)


def _fault(code: str, name: str, reason: str) -> Exception:
    if code != "decoder_ended":
        return ValueError(reason)
    return Refusal(code, f"The points in {name} could not be read: {reason}.", advice="Restart the job.")

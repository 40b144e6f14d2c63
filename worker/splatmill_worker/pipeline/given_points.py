"""Points that a training starts from, of a file of a laser scanner or a depth camera, in the world of given cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema import TrainOptions
from splatmill.schema.files.formats import is_point_file
from splatmill_worker.errors import Refusal
from splatmill_worker.images.decoding import decoders
from splatmill_worker.readers import scan
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
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


def with_given_points(scene: Scene, path: Path, cancelled: Callable[[], bool]) -> Scene:
    """The scene with those points of a file that its photos show, beside its own: a scan has holes, and no sky.

    The result has no tracks, since those of its own points alone would mean that no photo shows the others.

    Raises Refusal for a file that cannot be read or has no points, for a format whose library is not installed, and
    where the photos show none of the points; and Cancelled.
    """
    if (module := scan.lacking(path)) is not None:
        raise Refusal(
            "start_unusable",
            f"{path.name} cannot be read on this worker: the Python module {module} is not installed.",
            advice="Install it with pip install 'splatmill-worker[scans]', or give the points as .ply or .xyz.",
        )
    try:
        points, colors, count = decoders.call_once(scan.read, path, check=_points, fault=_fault)
    except OSError as error:
        raise _unusable(f"{path.name} cannot be opened: {error.strerror or error}.") from error
    except ValueError as error:
        raise _unusable(f"The points in {path.name} cannot be read: {plain(error)}.") from error
    if not len(points):
        raise _unusable(f"{path.name} holds no point with finite coordinates.")
    judged = posed.with_loose_points(
        replace(scene, points=points, colors=colors, point_views=None, point_errors=None, notes=()), cancelled
    )
    if not len(judged.points):
        raise Refusal(
            "start_unusable",
            f"The points of {path.name} do not fit the cameras. {' '.join(judged.notes)}",
            advice="Give points and cameras of one coordinate system, such as those that one program has exported "
            "together, or leave out the option start.",
        )
    note = f"{path.name} holds {count:,} points, of which {len(judged.points):,} are used: photos show their colours."
    return replace(
        scene,
        points=np.concatenate([scene.points, judged.points]),
        colors=np.concatenate([scene.colors, judged.colors]),
        point_views=None,
        point_errors=None,
        notes=(*scene.notes, note),
        facts=scene.facts | {"given_points": count, "given_points_used": len(judged.points)},
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

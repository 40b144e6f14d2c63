"""Points that a training starts from, of a file of a laser scanner or a depth camera, in the world of given cameras."""

from __future__ import annotations

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


def with_given_points(scene: Scene, path: Path) -> Scene:
    """The scene with the points of a file in place of its own. They have no tracks: `posed.with_points` judges them.

    Raises Refusal for a file that cannot be read or has no points, and for a format whose library is not installed.
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
    note = f"{path.name} holds {count:,} points"
    note += (
        f", of which {len(points):,}, evenly chosen, are compared with the photos."
        if len(points) < count
        else "."
    )
    return replace(scene, points=points, colors=colors, point_views=None, notes=(*scene.notes, note))


def require_shown(scene: Scene, path: Path) -> None:
    """Raise Refusal where the photos show hardly any of the points that `with_given_points` has given to `scene`."""
    if scene.facts.get("loose_points") and not scene.facts.get("loose_points_used"):
        judged = next(
            (note for note in reversed(scene.notes) if "not used" in note), "No photo shows any of them."
        )
        raise Refusal(
            "start_unusable",
            f"The points of {path.name} do not fit the cameras. {judged}",
            advice="Give points and cameras of one coordinate system, such as those that one program has exported "
            "together, or leave out the option start.",
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

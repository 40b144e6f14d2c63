"""Points of the depth maps of phones and depth cameras beside the photos, where the photos show them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema import TrainOptions
from splatmill.schema.quantities import counted, listed
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import depth_maps
from splatmill_worker.images.decoding import decoders
from splatmill_worker.pipeline import scan_fit
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.depth import pairs, points, unit
from splatmill_worker.sfm.depth.pixels import DepthMap, highest, without_edges
from splatmill_worker.sfm.posed import zipped
from splatmill_worker.sfm.world.frame import in_metres
from splatmill_worker.wording import plain

MAX_ASPECT_ERROR = 0.02
"""Relative difference of the shapes of a depth map and its photo that counts as rounding, besides that of one pixel."""

MILLIMETRE = 1e-3
"""Metres of a level of the depth maps of phones."""

FEW_LEVELS = 3
"""Levels of confidence that phones have: low, medium and high."""

Confidence = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class _Read:
    """What was read of the maps: distances and confidence by the index of the view, and what is wrong with others."""

    levels: dict[int, npt.NDArray[np.float32]]
    sure: dict[int, Confidence]
    faults: list[tuple[str, str]]


def with_depth(
    scene: Scene,
    training: Collection[str],
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Scene:
    """The scene with the points of its depth maps beside its own, and the reason where none is used.

    No depth map ends a job: the photos suffice without them. Those of held-out photos are not read.

    training: names of the views that are trained on.

    Raises OSError and ValueError for photos as `load_view` does, and Cancelled.
    """
    maps = pairs.maps_of(_folders(capture, workdir, cancelled), scene.views)
    if not maps.names and not maps.of_view:
        return scene
    scene = replace(scene, left_out=tuple(each for each in scene.left_out if not _named(each[0], maps)))
    if not maps.of_view:
        which = (
            f"{counted(len(maps.unpaired), 'depth map')} (such as {maps.unpaired[0]})"
            if maps.unpaired
            else ""
        )
        said = f"{which} belong to no photo by name, and no use is made of them. Call the map of a.jpg depth/a.png."
        return replace(scene, warnings=(*scene.warnings, said)) if which else scene
    paired = {index: each for index, each in maps.of_view.items() if scene.views[index].name in training}
    read = _read(scene.views, paired, on_progress, cancelled)
    warnings = _unread(read, len(paired))
    readings = _maps(read)
    if not any(each.sure.any() for each in readings):
        if readings:
            warnings.append("The depth maps are not used: none of their pixels has the highest confidence.")
        return replace(scene, warnings=(*scene.warnings, *warnings))
    measured = unit.of_maps(scene, readings)
    if isinstance(measured, str):
        warnings.append(f"The depth maps are not used: {measured}.")
        return replace(scene, warnings=(*scene.warnings, *warnings))
    others = [scene.views[index].name for index in measured.others]
    if others:
        warnings.append(
            f"{counted(len(others), 'depth map is', 'depth maps are')} not used, since at the points of the "
            f"photos, distances differ by more than {100 * unit.SPREAD:.0f} % by median: of {listed(others)}."
        )
    readings = [each for each in readings if each.index not in measured.others]
    positions, colors = points.of_maps(readings, scene.views, measured.length, cancelled)
    # Held-out photos do not judge what is trained from.
    of_training = replace(
        scene,
        views=tuple(view for view in scene.views if view.name in training),
        point_views=None,
        point_errors=None,
        track_lengths=None,
    )
    fit = scan_fit.as_it_lies(of_training, positions, colors, options.image_size, cancelled, from_photos=True)
    facts: dict[str, Any] = {
        "depth_maps": len(readings),
        "depth_unit": measured.length,
        "depth_unit_points": measured.points,
        "depth_unit_spread": measured.spread,
        "depth_points": len(positions),
        "depth_points_resolved": fit.resolved,
        "depth_points_used": len(fit.points),
        "sparse_points": scene.facts.get("sparse_points", len(scene.points)),
    }
    if not fit.fits:
        warnings.append(f"The depth maps are not used. {measured.sentence}. {fit.sentence}")
        return replace(scene, warnings=(*scene.warnings, *warnings), facts=scene.facts | facts)
    note = (
        f"{counted(len(readings), 'depth map')} of photos to train on give {len(positions):,} points of the highest "
        f"confidence. {measured.sentence}. One for each cell of {fit.pixels:.1f} pixels of the closest photo leaves "
        f"{fit.resolved:,}, of which {len(fit.points):,} are used: photos show their colours."
    )
    scene = replace(
        scan_fit.joined(scene, fit),
        notes=(*scene.notes, note),
        warnings=(*scene.warnings, *warnings),
        facts=scene.facts | facts,
    )
    return _in_metres(scene, measured.length) if read.sure else scene


def _in_metres(scene: Scene, length: float) -> Scene:
    """The scene with the metre as its unit, where that was arbitrary. length: of a millimetre in it."""
    if scene.frame is None or scene.frame.unit != "arbitrary":
        return scene
    before = scene.frame.reasons.get("unit")
    reason = "Metres, because the depth maps of a phone, which have maps of confidence, are in millimetres."
    resized = in_metres(scene, MILLIMETRE / length, reason)
    notes = tuple(reason if note == before else note for note in resized.notes)
    return replace(resized, notes=notes, facts=resized.facts | {"depth_unit": MILLIMETRE})


def _folders(capture: Path, workdir: Path, cancelled: Callable[[], bool]) -> list[Path]:
    """Where the maps of a capture may lie: in it, and in what its zips hold."""
    unpacked = workdir / "unpacked"
    folder = zipped.data_set(capture, workdir, cancelled)
    return [folder] if folder.is_relative_to(unpacked) else [folder, unpacked]


def _named(name: str, maps: pairs.Maps) -> bool:
    """Whether a file that is left out is one of the maps."""
    return name in maps.names or f"images/{name}" in maps.names


def _read(
    views: Sequence[View],
    paired: dict[int, tuple[Path, Path | None]],
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> _Read:
    read = _Read({}, {}, [])
    for done, (index, (path, sure)) in enumerate(paired.items(), 1):
        stop_if(cancelled)
        name = f"{path.parent.name}/{path.name}"
        try:
            levels = decoders.call(depth_maps.distances, path, name, check=_levels)
            camera = views[index].camera
            (height, width), shape = levels.shape, camera.width / camera.height
            if abs(width / height / shape - 1.0) > MAX_ASPECT_ERROR + 2.0 / min(width, height):
                raise UnusablePicture(
                    "not_an_image",
                    name,
                    f"it has {width} x {height} pixels, another shape than its photo with {camera.width} x "
                    f"{camera.height}",
                )
            if sure is not None:
                name = f"{sure.parent.name}/{sure.name}"
                read.sure[index] = _confidence(sure, (height, width))
            read.levels[index] = levels
        except UnusablePicture as error:
            read.faults.append((name, error.reason))
        except OSError as error:
            read.faults.append((name, f"it cannot be read: {plain(error)}"))
        on_progress("depth", done, len(paired), "depth maps read")
    return read


def _confidence(path: Path, size: tuple[int, int]) -> Confidence:
    """The levels of a map of confidence at the size of its depth map, height and width. Raises UnusablePicture."""
    name = f"{path.parent.name}/{path.name}"
    levels = decoders.call(depth_maps.confidences, path, name, check=_sure)
    if levels.shape == size:
        return levels
    if abs(levels.shape[1] / levels.shape[0] / (size[1] / size[0]) - 1.0) > MAX_ASPECT_ERROR:
        raise UnusablePicture(
            "not_an_image",
            name,
            f"the map of confidence has {levels.shape[1]} x {levels.shape[0]} pixels, another shape than its depth map "
            f"with {size[1]} x {size[0]}",
        )
    rows, columns = (
        np.minimum(((np.arange(count) + 0.5) * own / count).astype(int), own - 1)
        for count, own in zip(size, levels.shape, strict=True)
    )
    return levels[np.ix_(rows, columns)]


def _maps(read: _Read) -> list[DepthMap]:
    """The maps that were read, with the pixels that count: of the highest confidence, and on no edge."""
    occurring = np.unique(np.concatenate([np.zeros(0, np.uint8), *map(np.unique, read.sure.values())]))
    most, few = int(occurring.max(initial=0)), len(occurring) <= FEW_LEVELS
    maps = []
    for index, levels in read.levels.items():
        sure = without_edges(levels)
        if index in read.sure:
            sure &= highest(read.sure[index], most, few)
        maps.append(DepthMap(index, levels, sure))
    return maps


def _unread(read: _Read, count: int) -> list[str]:
    """A sentence about maps that are not used, with the reason of the first; none where all are."""
    if not read.faults:
        return []
    name, reason = read.faults[0]
    if len(read.faults) == 1:
        return [f"The depth map {name} is not used: {reason}."]
    which = "All" if len(read.faults) == count else f"{len(read.faults)} of"
    return [f"{which} {count} depth maps are not used, such as {name}: {reason}."]


def _levels(answer: Any) -> npt.NDArray[np.float32]:
    """What `depth_maps.distances` returns. Raises ValueError for anything else."""
    if answer.ndim != 2 or answer.dtype != np.float32 or not (np.isfinite(answer) & (answer >= 0.0)).all():
        raise ValueError("they are no distances")
    levels: npt.NDArray[np.float32] = answer
    return levels


def _sure(answer: Any) -> Confidence:
    """What `depth_maps.confidences` returns. Raises ValueError for anything else."""
    if answer.ndim != 2 or answer.dtype != np.uint8:
        raise ValueError("they are no levels of confidence")
    levels: Confidence = answer
    return levels

"""Photos whose files have the same bytes, to which different cameras are given: one camera of each is wrong."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatmill.schema.quantities import counted
from splatmill_worker.images.copies import SMALL_SIDE, small_grey
from splatmill_worker.images.decoding import decoders
from splatmill_worker.scene import Camera, Float, Scene, View, looked_at, without

ONE_CAMERA = 0.05
"""Median displacement, as a share of the longer side, up to which two cameras may be two estimates of one: cameras
that were recovered for each of two copies differ by less. Such photos are copies to `pipeline.near_copies`."""

MOST_CONTRADICTED = 0.5
"""Share of the photos that are left out for this; more are a fault of the data set."""

POINTS = 5
"""Points along each side of a photo whose displacement is measured."""

NAMED = 6
"""Photos that the warning names, at most."""


def without_contradicted(scene: Scene) -> Scene:
    """The scene without photos of the same bytes with different cameras, each with its reason, and a warning.

    Nothing says which of the cameras is right, so that none of these photos is used. Photos of one colour are kept:
    cameras that see no part of a scene may well take the same photo.

    Raises ValueError, naming the first two, where they are more than MOST_CONTRADICTED of all, and as `decoders.decode`
    does for a photo that cannot be read.
    """
    groups = [group for group in _same_bytes(scene.views) if not _is_plain(scene.views[group[0]])]
    if not groups:
        return scene
    target = looked_at(scene.centers, np.array([view.camera.axis for view in scene.views]))
    other: dict[int, int] = {}
    for group in groups:
        first = scene.views[group[0]]
        apart = [
            index for index in group[1:] if not _displacement(first, scene.views[index], target) <= ONE_CAMERA
        ]
        if apart:
            other |= dict.fromkeys(group, group[0]) | {group[0]: apart[0]}
    if not other:
        return scene
    one, another = (scene.views[index].name for index in next(iter(sorted(other.items()))))
    if len(other) > MOST_CONTRADICTED * len(scene.views):
        raise ValueError(
            f"{len(other)} of {len(scene.views)} photos with cameras have the same bytes as another one and a "
            f"different camera, such as {one} and {another}. Give each camera the photo that it took."
        )
    named = {index: scene.views[same].name for index, same in other.items()}
    for index in sorted(named, reverse=True):
        reason = f"its bytes are those of {named[index]}, to which a different camera is given"
        scene = without(scene, [index], reason)
    names = sorted(name for name, _ in scene.left_out[-len(other) :])
    warning = (
        f"{counted(len(other), 'photo')} with given cameras have the same bytes as another one and a different camera, "
        f"and are not used, since at most one of the cameras can be right: {', '.join(names[:NAMED])}"
        f"{f' and {len(names) - NAMED} more' if len(names) > NAMED else ''}. Give each camera the photo that it took."
    )
    return replace(scene, warnings=(*scene.warnings, warning))


def _same_bytes(views: Sequence[View]) -> Iterable[list[int]]:
    """The indices of the views of each content that several files have. Only files of one size are read."""
    sizes: dict[int, list[int]] = {}
    for index, view in enumerate(views):
        sizes.setdefault(view.image.stat().st_size, []).append(index)
    contents: dict[str, list[int]] = {}
    for group in sizes.values():
        for index in group if len(group) > 1 else ():
            contents.setdefault(_digest(views[index].image), []).append(index)
    return [group for group in contents.values() if len(group) > 1]


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_plain(view: View) -> bool:
    photo = decoders.decode(view.image, at_least=(SMALL_SIDE, SMALL_SIDE), upright=view.upright)
    return bool(np.ptp(small_grey(photo)) == 0)


def _displacement(view: View, other: View, target: Float) -> float:
    """Median distance between where two cameras see points at the distance of `target`, over the longer side; infinite
    where one has them behind it."""
    camera = view.camera
    distance = max(float(np.linalg.norm(target - camera.center)), 1e-6)
    here, there = (
        _pixels(each, camera.unproject(*_grid(camera, distance))) for each in (camera, other.camera)
    )
    shift = np.hypot(*(there - here)) / max(camera.width, camera.height)
    shift[np.isnan(shift)] = np.inf
    return float(np.median(shift))


def _grid(camera: Camera, distance: float) -> tuple[Float, Float, Float]:
    """Columns, rows and depths of points all over a photo."""
    shares = np.linspace(0.1, 0.9, POINTS)
    columns, rows = np.meshgrid(shares * camera.width, shares * camera.height)
    return columns.ravel(), rows.ravel(), np.full(columns.size, distance)


def _pixels(camera: Camera, points: Float) -> Float:
    projection = camera.project(points)
    return np.array([projection.columns, projection.rows])

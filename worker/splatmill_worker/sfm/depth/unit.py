"""The length of one level of depth maps in the world of their cameras: as stated, or by the points of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatmill_worker.scene import Float, Scene
from splatmill_worker.sfm.depth.pixels import DepthMap
from splatmill_worker.sfm.posed import visible

FEWEST = 20
"""Points of the scene on pixels that count, below which they say nothing of the unit."""

FEWEST_OF_VIEW = 10
"""Such points in one view, below which they say nothing of its own map."""

SPREAD = 0.05
"""Median deviation of the logarithm of the ratios, up to which they agree on a unit: half of the points lie within 5 %
of the distance that the map has there. Phones and depth cameras measure to 1 or 2 %."""

MOST_OTHERS = 0.5
"""Share of the maps that may be those of other photos, of all that have enough points."""

SAME = 0.1
"""Deviation of the logarithm, up to which two units are the same one."""

READINGS = {"millimetres": 1e-3, "levels of 1/5000 m, as of TUM RGB-D": 2e-4}
"""What levels of 16 bits usually are, in metres."""


@dataclass(frozen=True)
class Unit:
    """The unit of the depth maps of a scene.

    length: of one level, in the world.
    spread: median deviation of the logarithm of the ratios from it; None where it was not measured.
    points: number of points by which it was measured.
    others: indices of views whose own maps do not have the distances of the points, as those of other photos.
    sentence: where it comes from.
    """

    length: float
    spread: float | None
    points: int
    others: tuple[int, ...]
    sentence: str


def of_maps(scene: Scene, maps: Sequence[DepthMap]) -> Unit | str:
    """The unit of the maps, or a sentence that says why there is none.

    It is the median ratio of the depths of the scene's points and the levels at them, if these agree. A stated unit
    that agrees with it is used as it is. Where the scene has too few points, a stated one is used, and the
    photos judge it.
    """
    ratios = [_ratios(scene, each) for each in maps]
    every = np.concatenate([np.zeros(0), *ratios])
    stated = scene.depth_unit
    if len(every) < FEWEST:
        if stated is not None:
            return Unit(stated, None, len(every), (), f"One level is {stated:.4g} units, as the cameras say")
        middle = float(np.median(np.concatenate([each.levels[each.sure] for each in maps])))
        read = " or ".join(f"{middle * length:.3g} m (in {name})" for name, length in READINGS.items())
        return (
            f"their unit is not stated, and only {len(every)} points of the photos lie on them, by which it could be "
            f"measured: half of their distances are above {read}. Give transforms.json with depth_unit_scale_factor"
        )
    length = float(np.median(every))
    spread = float(np.median(np.abs(np.log(every / length))))
    judged = [
        (each.index, float(np.median(np.abs(np.log(own / length)))))
        for each, own in zip(maps, ratios, strict=True)
        if len(own) >= FEWEST_OF_VIEW
    ]
    others = tuple(index for index, own in judged if not own <= SPREAD)
    if not spread <= SPREAD or len(others) > MOST_OTHERS * len(judged):
        return (
            f"they do not show the distances of the scene: at {len(every):,} points of the photos, the ratio of both "
            f"differs by {100 * np.expm1(spread):.1f} % from its median {length:.3g} by median, and by more than "
            f"{100 * SPREAD:.0f} % in {len(others)} of {len(judged)} maps. They belong to other photos or cameras, or "
            "are no distances along the optical axis, such as inverse or relative depths"
        )
    measured = f"{len(every):,} points of the photos, which lie within {100 * np.expm1(spread):.1f} % of it by median"
    if stated is not None and abs(np.log(length / stated)) <= SAME:
        said = f"One level is {stated:.4g} units, as the cameras say and {measured}"
        return Unit(stated, spread, len(every), others, said)
    said = f"One level is {length:.4g} units by {measured}"
    if stated is not None:
        said += f"; the cameras say {stated:.4g}, which differs by a factor of {length / stated:.3g}"
    return Unit(length, spread, len(every), others, said)


def _ratios(scene: Scene, depth: DepthMap) -> Float:
    """Depth over level at each point that the view of a map sees."""
    view = scene.views[depth.index]
    if scene.point_views is None:
        rows = visible(view.camera, view.camera.project(scene.points))
    else:
        offsets, views = scene.point_views
        rows = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))[views == depth.index]
    _, depths, levels = depth.at(view, scene.points[rows])
    ratios: Float = depths / levels
    return ratios

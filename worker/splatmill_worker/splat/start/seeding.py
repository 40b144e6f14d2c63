"""Seeding: Gaussians in gaps and on a far shell, added to those made from points, within the limit on their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.scene import Scene
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.start import far_shell, gaps
from splatmill_worker.splat.start.cells import cells_of
from splatmill_worker.splat.start.points import INITIAL_OPACITY, from_points, logit
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]


class Seeds(NamedTuple):
    """Points [k, 3] that may be added, and their colours uint8 [k, 3].

    shell: on the far shell.
    gaps: in the gaps between the points.
    """

    shell: tuple[Float, Pixels]
    gaps: tuple[Float, Pixels]


def add_seeds(
    gaussians: Gaussians,
    scene: Scene,
    views: Sequence[TrainingView],
    *,
    seeds: Seeds | None = None,
    fill_gaps: bool,
    add_far_shell: bool,
    max_gaussians: int,
    backend: ops.Backend | None = None,
    tell: Callable[[str], None] = lambda part: None,
) -> Gaussians:
    """`gaussians`, which were made from the points of `scene`, with more in the gaps between them and on a far shell.

    At most `max_gaussians` result. Where there would be more, those added are thinned evenly: those in the gaps first,
    then those on the shell.

    seeds: those of these photos; None: they are found.
    tell: called with what is done, before the part that takes seconds where there are many photos.
    """
    if not (fill_gaps or add_far_shell):
        return gaussians
    cells = cells_of(scene, views) if seeds is None else []
    additions: list[tuple[Float, Pixels, float]] = []
    if add_far_shell:
        shell = far_shell.shell_points(cells, scene.points) if seeds is None else seeds.shell
        additions.append((*shell, far_shell.OPACITY))
    if fill_gaps:
        if seeds is None:
            tell("filling gaps between the points")
        additions.append((*(gaps.gap_points(cells) if seeds is None else seeds.gaps), INITIAL_OPACITY))
    parts = [gaussians]
    room = max(0, max_gaussians - gaussians.count)
    for points, colors, opacity in additions:
        points, colors = _at_most(room, points, colors)
        room -= len(points)
        if len(points) > 1:
            # Made apart from `gaussians`, so that their widths follow from the distances between the added points.
            more = from_points(torch.from_numpy(points), torch.from_numpy(colors), backend=backend)
            parts.append(replace(more, logit_opacities=torch.full((more.count,), logit(opacity))))
    return concatenate(*parts)


def _at_most(room: int, points: Float, colors: Pixels) -> tuple[Float, Pixels]:
    """All points and colours, or `room` of them, evenly chosen, where there are more."""
    if len(points) <= room:
        return points, colors
    rows = np.linspace(0, len(points), room, endpoint=False).astype(np.int64)
    return points[rows], colors[rows]

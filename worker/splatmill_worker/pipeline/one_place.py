"""Says where all photos were taken from nearly one place, so that they do not show how far anything is."""

from __future__ import annotations

import numpy as np

from splatmill_worker.images.panoramas.faces import photos_of
from splatmill_worker.scene import Scene

LEAST_BASELINE = 0.05
"""Largest distance of two cameras, over the median distance of the points, below which depths are hardly determined:
the directions to a point then differ by less than three degrees, as those of cameras that only turned seem to after
their recovery."""

MIN_POINTS = 8
"""Points below which their distance is not known: there is a warning then only where the cameras are in one place."""


def warning(scene: Scene) -> list[str]:
    """A sentence for the user where all cameras of a scene are in nearly the same place; none where they are not."""
    centers = scene.centers
    if len(centers) < 2:
        return []
    # The extent along the axes is the largest distance up to a factor of 1.7, whatever the number of cameras.
    baseline = float(np.linalg.norm(np.ptp(centers, axis=0)))
    middle = centers.mean(axis=0)
    depth = (
        float(np.median(np.linalg.norm(scene.points - middle, axis=1)))
        if len(scene.points) >= MIN_POINTS
        else 0.0
    )
    # Without points, rounding alone is left out of consideration.
    if baseline > LEAST_BASELINE * depth + 1e-9 * float(np.abs(centers).max()):
        return []
    share = f", {baseline / depth:.1%} of the distance of what they show" if depth else ""
    return [
        f"All {photos_of(scene.views)} photos were taken from nearly one place{share}. They do not show how far "
        "anything is: views from other places will be wrong, and a high PSNR says nothing of them. Move sideways "
        "between photos, rather than turn in place."
    ]

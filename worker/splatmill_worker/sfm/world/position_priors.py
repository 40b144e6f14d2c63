"""Positions by GPS as observations of an adjustment: they hold the shape of a large scene where photos alone hardly do.

Photos of a wide, flat scene leave a bulge of all of it nearly free: a slightly wrong lens explains it (James and
Robson, "Mitigating systematic error in topographic models derived from UAV and ground-based image networks", 2014).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Float
from splatmill_worker.sfm.world import geodesy, georeference

PHOTOS_PER_ERROR = 3
"""Photos that count as one, since the error of GPS changes slowly. The variance of each prior is multiplied by it
(decisions: position-priors)."""

LEAST_PIXELS = 0.05
"""Error of an observation in pixels, at least, against which that of GPS is weighed: a smaller one would be a
perfect fit of generated data."""


@dataclass(frozen=True)
class PositionPriors:
    """Where the photos of a model were by GPS.

    to_metres: from the world of the model to metres to the east, to the north and upwards.
    priors: of each photo whose position agrees with the others, in those metres.
    error: standard deviation of a coordinate of one of them, in metres, at least georeference.GPS_ERROR. The covariance
        of a prior is larger, because the solver takes the error of an observation for one pixel.
    """

    to_metres: pycolmap.Sim3d
    priors: tuple[pycolmap.PosePrior, ...]
    error: float


def position_priors(model: pycolmap.Reconstruction, places: Mapping[int, Float]) -> PositionPriors | None:
    """The priors of the registered photos of `model`, whose points hold their reprojection errors.

    places: latitude and longitude in degrees and altitude in metres, float64 [3], of each photo by its image's id; not
        finite where the photo has none.

    None where too few photos have a whole position, where all altitudes are one value, which a program may have
    written for those that it did not know, where positions do not agree with the cameras, and where they lie along a
    line: photos beside it could be anywhere around it.
    """
    images = sorted(model.reg_image_ids())
    known = [image for image in images if np.isfinite(places[image]).all()]
    if not known or len(known) < georeference.AGREEING * len(images):
        return None
    measured = np.array([places[image] for image in known])
    if not np.ptp(measured[:, 2]) > 0.0:
        return None
    metres = geodesy.local(measured, np.median(measured, axis=0))
    centers = np.array([model.images[image].projection_center() for image in known])
    fit = georeference.fit(centers, metres)
    if isinstance(fit, str) or georeference.down_by(fit) is None:
        return None
    pixels = max(LEAST_PIXELS, model.compute_mean_reprojection_error())
    covariance = PHOTOS_PER_ERROR * (fit.error / pixels) ** 2 * np.eye(3)
    priors = tuple(
        pycolmap.PosePrior(
            corr_data_id=model.images[image].data_id,
            position=place,
            position_covariance=covariance,
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image, place, agrees in zip(known, metres, fit.agreeing, strict=True)
        if agrees
    )
    turn = pycolmap.Rotation3d(fit.rotation)
    return PositionPriors(pycolmap.Sim3d(fit.scale, turn, fit.translation), priors, fit.error)

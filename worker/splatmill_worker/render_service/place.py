"""The place of a model on the earth, by the frame.json beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ValidationError

from splatmill.schema import ModelFrame
from splatmill_worker.scene import Float


def place_beside(model: Path) -> Float | None:
    """Matrix [4,4] from metres east, north and up of the origin of a model file to metres from the earth's centre.

    None where there is no frame.json beside it that can be read and has a place in metres. An altitude that the photos
    do not give counts as 0.
    """
    try:
        frame = ModelFrame.model_validate_json(model.with_name("frame.json").read_bytes())
    except (OSError, ValidationError):
        return None
    if frame.origin is None or frame.unit != "metre":
        return None
    # It loads COLMAP, which models without a place do not need.
    from splatmill_worker.sfm.world.geodesy import to_earth_centered

    place = np.array([frame.origin.latitude, frame.origin.longitude, frame.origin.altitude or 0.0])
    return to_earth_centered(place) if np.isfinite(place).all() else None

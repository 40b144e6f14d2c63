"""Where up is in the world of a model, by the cameras of its photos: what a `.glb` is turned by, whose y is up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ValidationError

from splatmill.schema import ModelCameras
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.sfm.world.upright import down_of
from splatmill_worker.splat.formats.gltf import Up

NEAR = np.cos(np.radians(20.0))
"""Cosine of the angle to an axis of the world, up to which it is meant: programs give one to up."""

FEWEST = 3
"""Cameras that a world needs for its up to be known."""


def up_of(stored: ModelCameras | None) -> Up | None:
    """A unit vector up, in the world of a model with these cameras; None where it does not follow from them.

    It is what they say, as those of recovered cameras do. Otherwise it is the axis of the world that is nearest to what
    is up for most of the photos. In a world that has none, as that of a COLMAP model, it is that direction itself, if
    nothing speaks against it.
    """
    if stored is None:
        return None
    if stored.up is not None:
        return stored.up
    if len(stored.cameras) < FEWEST:
        return None
    rotations = np.stack([camera_of(row.camera).viewmat[:3, :3] for row in stored.cameras])
    down = down_of(rotations)
    axis = int(np.abs(down.direction).argmax())
    if abs(down.direction[axis]) < NEAR:
        x, y, z = (float(value) for value in -down.direction)
        return None if down.doubt else (x, y, z)
    x, y, z = (-float(np.sign(value)) * (index == axis) for index, value in enumerate(down.direction))
    return x, y, z


def up_beside(model: Path) -> Up | None:
    """`up_of` the cameras.json beside a model file; None where there is none that can be read."""
    try:
        return up_of(ModelCameras.model_validate_json(model.with_name("cameras.json").read_bytes()))
    except (OSError, ValidationError):
        return None

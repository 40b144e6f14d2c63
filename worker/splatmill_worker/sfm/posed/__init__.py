"""Captures that bring their cameras: a COLMAP model, transforms.json, or a Blender data set; and their points."""

from splatmill_worker.sfm.posed.camera_models import UnreadModel
from splatmill_worker.sfm.posed.capture import PosedInput, find
from splatmill_worker.sfm.posed.points import with_points

__all__ = ["PosedInput", "UnreadModel", "find", "with_points"]

"""Captures that bring their cameras: a COLMAP model, transforms.json, or files of other programs; and their points."""

from splatmill_worker.sfm.posed.camera_models import UnreadModel
from splatmill_worker.sfm.posed.capture import PosedInput, find, without_cameras
from splatmill_worker.sfm.posed.judged.points import with_loose_points, with_points
from splatmill_worker.sfm.posed.programs import TwoFiles

__all__ = [
    "PosedInput",
    "TwoFiles",
    "UnreadModel",
    "find",
    "with_loose_points",
    "with_points",
    "without_cameras",
]

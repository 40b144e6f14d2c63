"""Captures that bring their cameras: a COLMAP model, transforms.json, or files of other programs; and their points."""

from splatmill_worker.sfm.posed.camera_models import UnreadModel
from splatmill_worker.sfm.posed.capture import PosedInput, find, without_cameras
from splatmill_worker.sfm.posed.judged.evidence import evidence_of
from splatmill_worker.sfm.posed.judged.footprints import footprints, resolved
from splatmill_worker.sfm.posed.judged.points import MOST_LOOSE, by_chance, with_loose_points, with_points
from splatmill_worker.sfm.posed.judged.uncolored import seen_in
from splatmill_worker.sfm.posed.judged.visible import visible
from splatmill_worker.sfm.posed.programs import TwoFiles

__all__ = [
    "MOST_LOOSE",
    "PosedInput",
    "TwoFiles",
    "UnreadModel",
    "by_chance",
    "evidence_of",
    "find",
    "footprints",
    "resolved",
    "seen_in",
    "visible",
    "with_loose_points",
    "with_points",
    "without_cameras",
]

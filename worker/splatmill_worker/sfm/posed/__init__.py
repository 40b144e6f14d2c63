"""Captures that bring their cameras: a COLMAP model, transforms.json, or a Blender data set."""

from splatmill_worker.sfm.posed.capture import PosedInput, find, with_stereo_points

__all__ = ["PosedInput", "find", "with_stereo_points"]

"""Captures that bring their cameras: a COLMAP model, transforms.json, or a Blender data set."""

from splatmill_worker.sfm.posed.capture import PosedInput, completed, find

__all__ = ["PosedInput", "completed", "find"]

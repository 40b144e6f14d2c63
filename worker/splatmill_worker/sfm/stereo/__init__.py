"""Points added by multi-view stereo where structure from motion found few, or where given cameras brought none."""

from splatmill_worker.sfm.stereo.points import StereoPoints, add, observations_per_view
from splatmill_worker.sfm.stereo.search import VERSION, find_points, has_few_points, with_stereo_points

__all__ = [
    "VERSION",
    "StereoPoints",
    "add",
    "find_points",
    "has_few_points",
    "observations_per_view",
    "with_stereo_points",
]

"""From photos to cameras: structure from motion, or the cameras that a capture brings along."""

from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm.options import SfmOptions
from splatmill_worker.sfm.solve import reconstruct, reconstruct_photos

__all__ = ["SfmFailed", "SfmOptions", "reconstruct", "reconstruct_photos"]

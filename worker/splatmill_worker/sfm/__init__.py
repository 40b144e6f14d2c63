"""From photos to cameras: structure from motion, or the cameras a capture brings along."""

from splatmill_worker.errors import Cancelled, SfmFailed
from splatmill_worker.sfm.options import SfmOptions
from splatmill_worker.sfm.solve import reconstruct, reconstruct_photos

__all__ = ["Cancelled", "SfmFailed", "SfmOptions", "reconstruct", "reconstruct_photos"]

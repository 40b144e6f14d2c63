"""Photos: which of the given files are usable, what zips and videos hold, and their pixels at the training size."""

from splatmill_worker.images.load import Photo, load_view, load_views, training_size
from splatmill_worker.images.prepare import Prepared, UsablePhoto, prepare

__all__ = ["Photo", "Prepared", "UsablePhoto", "load_view", "load_views", "prepare", "training_size"]

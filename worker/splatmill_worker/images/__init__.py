"""Photos: which files are usable, their pixels, and the frames of videos and zips."""

from splatmill_worker.images.load import Photo, load_view, load_views, training_size
from splatmill_worker.images.prepare import Prepared, Usable, prepare

__all__ = ["Photo", "Prepared", "Usable", "load_view", "load_views", "prepare", "training_size"]

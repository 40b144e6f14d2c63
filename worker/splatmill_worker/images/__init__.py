"""Photos: which files are usable, their pixels, and the frames of videos and zips."""

from splatmill_worker.images.load import Photo, load_view, load_views, training_size

__all__ = ["Photo", "load_view", "load_views", "training_size"]

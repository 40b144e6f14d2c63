"""The definition of every op in plain torch: any dtype, gradients by autograd, slow. Other backends agree with it."""

from .adam import adam_, catch_up_
from .bin import bin
from .composite import composite
from .correlate import correlate
from .knn import knn
from .loss import PhotoStats, loss, photo_stats
from .median_depth import median_depth
from .project import project

__all__ = [
    "PhotoStats",
    "adam_",
    "bin",
    "catch_up_",
    "composite",
    "correlate",
    "knn",
    "loss",
    "median_depth",
    "photo_stats",
    "project",
]

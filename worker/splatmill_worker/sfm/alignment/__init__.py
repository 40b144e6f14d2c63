"""Aligns the points of a scan to a scene by a similarity: a first guess from nothing, and a robust ICP.

Of the libraries of registration, none of which was tried, their documentation says this: small_gicp registers without a
scale, which is unknown here; open3d can estimate one, and takes 400 MB; teaserpp needs correspondences; probreg and
pycpd need a good first guess, and time and memory that grow with the product of the numbers of points. What is used of
a library is the search tree, scipy's cKDTree.
"""

from splatmill_worker.sfm.alignment.align import Aligned, Unaligned, align
from splatmill_worker.sfm.alignment.cloud import LIBRARY

__all__ = ["LIBRARY", "Aligned", "Unaligned", "align"]

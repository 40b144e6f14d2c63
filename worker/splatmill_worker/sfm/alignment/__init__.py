"""Aligns the points of a scan to a scene by a similarity: a first guess from nothing, and a robust ICP.

Libraries of registration were looked at first: small_gicp and open3d register rigidly, without the scale, which is
unknown here; open3d takes 400 MB; probreg and pycpd estimate a scale from a good first guess, in time and memory that
grow with the product of the numbers of points. What is kept of a library is the search tree, scipy's cKDTree.
"""

from splatmill_worker.sfm.alignment.align import Aligned, Unaligned, align
from splatmill_worker.sfm.alignment.cloud import LIBRARY

__all__ = ["LIBRARY", "Aligned", "Unaligned", "align"]

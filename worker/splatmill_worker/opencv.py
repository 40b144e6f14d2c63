"""OpenCV's SIFT and nothing else of it; restores the environment that its import changes, and keeps it to one thread.

On import, OpenCV puts a folder of its own in LD_LIBRARY_PATH, and behind it an empty one, for which the loader of every
later process would take the folder that it is started in. Photos are searched in parallel, each by one thread, so
OpenCV starts none of its own.
"""

from __future__ import annotations

import os

_BEFORE = os.environ.get("LD_LIBRARY_PATH")

import cv2  # noqa: E402

if _BEFORE is None:
    os.environ.pop("LD_LIBRARY_PATH", None)
else:
    os.environ["LD_LIBRARY_PATH"] = _BEFORE
cv2.setNumThreads(1)

SIFT = cv2.SIFT
VERSION = cv2.__version__

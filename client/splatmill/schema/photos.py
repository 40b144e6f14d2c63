"""Which files count as photos, masks, videos and archives, and how many pixels a photo may have.

Suffixes are in lower case with their dot. The client decides by them what to upload, the server whether a capture can
be trained, the worker what to decode; the worker then judges a photo by its contents, whatever its suffix.
"""

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".heic", ".heif")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
ARCHIVE_SUFFIXES = (".zip",)

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
"""In the order in which the mask of a photo is looked for."""

MASK_FOLDERS = ("masks", "mask")
"""Folders of a data set that hold masks; the first one that exists is used."""

MIN_PHOTO_SIDE = 16
"""Pixels. A smaller photo has hardly any features to match and covers one tile at most in training."""

MAX_PHOTO_PIXELS = 250_000_000
"""Pixels. A larger photo is left out without being decoded; the largest phone cameras make 200 million."""

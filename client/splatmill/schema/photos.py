"""Which files count as photos, masks, videos and archives, and how many pixels a photo may have.

Suffixes are in lower case and begin with a dot. The client selects the files to upload by them, and the server checks
whether a capture can be trained. The worker recognises videos and archives by them, and photos by their contents.
"""

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".heic", ".heif")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
ARCHIVE_SUFFIXES = (".zip",)

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
"""In the order in which the mask of a photo is searched for."""

MASK_FOLDERS = ("masks", "mask")
"""Folders of a data set that hold masks; the first one that exists is used."""

MIN_PHOTO_SIDE = 16
"""Pixels. A smaller photo has hardly any features, and covers one tile of the renderer at most."""

MAX_PHOTO_PIXELS = 250_000_000
"""Pixels. A larger photo is left out without being decoded. The largest phone cameras have 200 million."""

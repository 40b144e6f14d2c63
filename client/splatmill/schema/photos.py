"""Which files count as photos, masks, videos and archives, and how many pixels a photo may have.

Suffixes are in lower case and begin with a dot. The client selects the files to upload by them, and the server checks
whether a capture can be trained. The worker recognises videos and archives by them, and photos by their contents.
"""

PHOTO_SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".png",
    ".webp",
    ".tif",
    ".tiff",
    ".heic",
    ".heif",
    ".avif",
)
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
ARCHIVE_SUFFIXES = (".zip",)

MASK_SUFFIXES = tuple(sorted(PHOTO_SUFFIXES, key=lambda suffix: suffix != ".png"))
"""In the order in which the mask of a photo is searched for. Which pictures are masks: `masks.py`."""

MIN_PHOTO_SIDE = 16
"""Pixels. A smaller photo has hardly any features, and covers one tile of the renderer at most."""

MAX_PHOTO_PIXELS = 250_000_000
"""Pixels. A larger photo is left out without being decoded. The largest phone cameras have 200 million."""

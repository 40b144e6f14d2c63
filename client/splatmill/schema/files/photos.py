"""Which files count as photos, masks, videos and archives, and how many pixels a photo may have.

Suffixes are in lower case and begin with a dot. The client selects the files to upload by them, and the server checks
whether a capture can be trained. The worker recognises videos and archives by them, and photos by their contents.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from os.path import splitext

from splatmill.schema.quantities import listed

PHOTO_FORMATS = {
    "JPEG": (".jpg", ".jpeg", ".jpe", ".jfif"),
    "PNG": (".png",),
    "WEBP": (".webp",),
    "TIFF": (".tif", ".tiff"),
    "HEIF": (".heic", ".heif"),
    "AVIF": (".avif",),
}
"""The formats of photos by Pillow's names, with their suffixes."""

VIDEO_FORMATS = {"mov": (".mp4", ".mov", ".m4v"), "matroska": (".mkv", ".webm"), "avi": (".avi",)}
"""The containers of videos by FFmpeg's names, with their suffixes."""

PHOTO_SUFFIXES = tuple(suffix for suffixes in PHOTO_FORMATS.values() for suffix in suffixes)
VIDEO_SUFFIXES = tuple(suffix for suffixes in VIDEO_FORMATS.values() for suffix in suffixes)
ARCHIVE_SUFFIXES = (".zip", ".r3d")

EXAMPLE_FILE = "still-life.example"
"""Name of a file among the images, of any content. Where it is a capture's only file, the worker makes photos of the
built-in still life in its place."""

MASK_SUFFIXES = tuple(sorted(PHOTO_SUFFIXES, key=lambda suffix: suffix != ".png"))
"""In the order in which the mask of a photo is searched for. Which pictures are masks: `masks.py`."""

MIN_PHOTOS = 3
"""Photos from which cameras can be recovered, at least."""

MIN_PHOTO_SIDE = 16
"""Pixels. A smaller photo has hardly any features, and covers one tile of the renderer at most."""

MAX_PHOTO_PIXELS = 250_000_000
"""Pixels. A larger photo is left out without being decoded. The largest phone cameras have 200 million."""


@dataclass(frozen=True)
class UnreadKind:
    """A kind of photos, videos or archives that people have and that is not read.

    what: the files, for a sentence. suffixes: of their names. advice: what to do, as a sentence.
    """

    what: str
    suffixes: tuple[str, ...]
    advice: str


UNREAD_KINDS = (
    UnreadKind(
        "raw photos",
        (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
        "Develop them as JPEG or TIFF, all with the same settings.",
    ),
    UnreadKind(
        "pictures of other formats",
        (".bmp", ".gif", ".jxl", ".jp2", ".psd", ".exr", ".hdr", ".tga", ".ppm"),
        "Save them as PNG or JPEG.",
    ),
    UnreadKind(
        "files of a 360-degree camera",
        (".insv", ".insp", ".360"),
        "Export flat photos or a flat video with the program of the camera.",
    ),
    UnreadKind(
        "videos of other formats",
        (".mts", ".m2ts", ".wmv", ".flv", ".3gp", ".mpg", ".mpeg"),
        "Convert them to MP4.",
    ),
    UnreadKind(
        "archives of other formats",
        (".rar", ".7z", ".tar", ".tgz", ".gz", ".bz2", ".xz"),
        "Unpack them, or pack the photos as a zip.",
    ),
)


def unread_kind(name: str) -> UnreadKind | None:
    """Return the one of UNREAD_KINDS that a file of this name is."""
    suffix = splitext(name)[1].lower()
    return next((kind for kind in UNREAD_KINDS if suffix in kind.suffixes), None)


def unread(names: Iterable[str]) -> list[str]:
    """Return a sentence for each of UNREAD_KINDS that is among the files `names`."""
    names_by_kind: dict[UnreadKind, list[str]] = {}
    for name in names:
        if (kind := unread_kind(name)) is not None:
            names_by_kind.setdefault(kind, []).append(name)
    return [
        f"Not read are {kind.what}: {listed(files, 1)}. {kind.advice}"
        for kind, files in names_by_kind.items()
    ]

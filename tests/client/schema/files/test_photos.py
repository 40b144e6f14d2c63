"""Suffixes and size limits of photos exist once: no other file of the three parts spells them.

Does not prove that a photo of each kind decodes; the worker's tests of images do.
"""

from pathlib import Path

from splatmill.schema import (
    ARCHIVE_SUFFIXES,
    MASK_SUFFIXES,
    MAX_PHOTO_PIXELS,
    PHOTO_SUFFIXES,
    VIDEO_SUFFIXES,
)
from tests.support.paths import ROOT

PARTS = ("client/splatmill", "server/splatmill_server", "worker/splatmill_worker")
HERE_ALONE = Path("client/splatmill/schema/files/photos.py")


def spelling(*texts: str) -> set[str]:
    """Source files that contain one of these texts."""
    files = [path for part in PARTS for path in (ROOT / part).rglob("*.py")]
    assert len(files) > 100
    return {
        str(path.relative_to(ROOT))
        for path in files
        if any(text in path.read_text("utf-8") for text in texts)
    }


def test_suffixes_are_spelt_in_one_file() -> None:
    rare = [f'"{suffix}"' for suffix in (".heic", ".tiff", ".mkv", ".m4v", ".avi", ".zip")]
    assert spelling(*rare) == {str(HERE_ALONE)}


def test_the_limit_on_pixels_is_spelt_in_one_file() -> None:
    assert spelling(str(MAX_PHOTO_PIXELS), f"{MAX_PHOTO_PIXELS:_}") == {str(HERE_ALONE)}


def test_each_suffix_has_one_meaning() -> None:
    kinds = (PHOTO_SUFFIXES, VIDEO_SUFFIXES, ARCHIVE_SUFFIXES)
    every = [suffix for kind in kinds for suffix in kind]
    assert len(every) == len(set(every))
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in every)
    assert set(MASK_SUFFIXES) <= set(PHOTO_SUFFIXES)

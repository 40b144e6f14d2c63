"""A photo without a file, for what is decided by names, sizes and EXIF alone."""

from pathlib import Path
from typing import Any

from splatmill_worker.images import exif
from splatmill_worker.images.prepare import UsablePhoto


def usable(name: str, **tags: Any) -> UsablePhoto:
    return UsablePhoto(name, Path(name), name, 640, 480, exif.Exif(**tags))

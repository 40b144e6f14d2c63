"""A stored file at a second path that stays readable when the stored one is deleted: a link, a clone or a copy."""

import fcntl
import os
import shutil
from contextlib import suppress
from pathlib import Path

from splatmill.files import replacing

FICLONE = 0x40049409
"""Linux's request for a clone: a file with the same blocks, copied on write (Btrfs, XFS, ZFS)."""


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source`; where none can be made, as on another file system, a clone or a copy.

    Never a symbolic link: it would break when the source is deleted. A file at `target` is replaced.
    Raises FileNotFoundError when there is no `source`, and OSError when the copy cannot be written.
    """
    with replacing(target) as part:
        try:
            os.link(source, part)
        except FileNotFoundError:
            raise
        except OSError:
            _clone_or_copy(source, part)


def _clone_or_copy(source: Path, target: Path) -> None:
    with source.open("rb") as original, target.open("wb") as taken:
        with suppress(OSError):  # most file systems clone nothing, and none does to another one
            fcntl.ioctl(taken.fileno(), FICLONE, original.fileno())
            return
        shutil.copyfileobj(original, taken, 1 << 20)

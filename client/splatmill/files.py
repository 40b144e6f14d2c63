"""Writing a file atomically: readers see the old file or the new one, never a part of it."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_KEPT_NAME = 40  # characters of the target's name in the temporary one, which may have 255 bytes in all


@contextmanager
def replacing(target: Path, *, sync: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file beside `target`, and rename it to `target` when the block ends.

    The caller creates the file. Its name is unique, hidden and ends in `.part` whatever the suffix of `target`, so
    a library that infers a format from the suffix must be told the format. Missing parent folders are created.
    With `sync`, the contents and the rename reach the disk before the call returns, which survives a power cut.

    When the block raises, `target` stays as it was and the temporary file is removed. Raises FileNotFoundError
    when the block has not created the file, and OSError when the file cannot be renamed or synced.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.name[:_KEPT_NAME]}.{secrets.token_hex(4)}.part")
    try:
        yield part
        move_into_place(part, target, sync=sync)
    finally:
        part.unlink(missing_ok=True)


def atomic_write(target: Path, data: bytes | str, *, sync: bool = False) -> None:
    """Write `data` (text as UTF-8) to `target` through `replacing`; see there for the rest."""
    with replacing(target, sync=sync) as part:
        part.write_bytes(data if isinstance(data, bytes) else data.encode())


def move_into_place(part: Path, target: Path, *, sync: bool = False) -> None:
    """Rename the finished file `part` to `target` in the same folder, replacing the file there.

    With `sync`, the contents reach the disk before the rename, and the rename before the call returns.
    """
    if sync:
        sync_to_disk(part)
    part.replace(target)
    if sync:
        sync_to_disk(target.parent)


def sync_to_disk(path: Path) -> None:
    """Return once a file, or the entries of a folder, survive a power cut. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

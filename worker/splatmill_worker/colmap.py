"""Imports pycolmap, restores the handler of SIGTERM, silences pycolmap's log, and writes models whole or not at all.

On import, pycolmap installs handlers for SIGTERM and for crashes that print a stack trace and abort: a worker that is
asked to end would dump core instead of handing its job back. Its log goes to stderr; errors are raised as exceptions
as well.
"""

from __future__ import annotations

import errno
import os
import signal
import threading
from pathlib import Path

_BEFORE = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _BEFORE if _BEFORE is not None else signal.SIG_DFL)
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)

__all__ = ["pycolmap", "write_model"]


def write_model(model: pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> None:
    """Write COLMAP's files of a model to an existing folder, and read them again.

    COLMAP does not notice a disk that is full: its files end early then. Raises OSError for files that are not whole.
    """
    (model.write_text if text else model.write_binary)(folder)
    try:
        written = pycolmap.Reconstruction()
        (written.read_text if text else written.read_binary)(folder)
    except (OSError, ValueError, RuntimeError, IndexError):
        whole = False
    else:
        whole = written.num_images() == model.num_images() and written.num_points3D() == model.num_points3D()
    if not whole:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))

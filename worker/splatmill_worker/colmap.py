"""Imports pycolmap, restores the handler of SIGTERM, and silences pycolmap's log.

On import, pycolmap installs handlers for SIGTERM and for crashes that print a stack trace and abort: a worker that is
asked to end would dump core instead of handing its job back. Its log goes to stderr; errors are raised as exceptions
as well.
"""

from __future__ import annotations

import signal
import threading

_BEFORE = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _BEFORE if _BEFORE is not None else signal.SIG_DFL)
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)

__all__ = ["pycolmap"]

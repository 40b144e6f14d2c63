"""Imports pycolmap without letting it take over the process.

On import it installs handlers for SIGTERM and the crash signals that print a stack trace and abort: a worker
told to end would die with a core dump instead of handing its job back. It also talks on stderr about each step;
what goes wrong comes back as an exception anyway.
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

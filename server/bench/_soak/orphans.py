"""Processes that have lost their parent: the kernel gives them to the soak, which thereby sees each."""

import ctypes
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import psutil

from splatmill.process import start_time

_PR_SET_CHILD_SUBREAPER = 36


class Adoption:
    """This process as the one to which the kernel gives the orphans among all processes below it, until `end`.

    own: the children that this process had before.
    missing: why this system has nothing of the kind, or None.
    """

    def __init__(self) -> None:
        self.missing = None if sys.platform == "linux" else "only Linux gives orphans to a process of our own"
        self.own = {child.pid for child in psutil.Process().children()}
        self._set(1)

    def end(self) -> None:
        """Be a process as others."""
        self._set(0)

    def orphans(self, own: Iterable[int]) -> list[int]:
        """Return the processes that run and were given to this one, which is not their parent.

        own: the children that the soak has started itself.
        """
        if self.missing is not None:
            return []
        pids = {child.pid for child in psutil.Process().children()} - self.own - set(own)
        for pid in pids:
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)  # one that has ended waits for this
        return sorted(pid for pid in pids if start_time(pid) is not None)

    def _set(self, value: int) -> None:
        if self.missing is None:
            ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, value, 0, 0, 0)


def command(pid: int) -> str:
    """Return the command line of a process, for a sentence about it."""
    try:
        return (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:200]
    except OSError:
        return "it has just ended"

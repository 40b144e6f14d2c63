"""The programs of the server and the worker: whether their part is installed, and how a command becomes one of them."""

import importlib.util
import os
import sys
from typing import NoReturn

from splatmill.errors import ServiceFailed

ALL_PARTS = "pip install splatmill 'splatmill-server[embedded]' splatmill-worker"


def require(part: str, needed_for: str) -> None:
    """Raise ServiceFailed, with the command that installs it, if the package `part` is not installed."""
    if importlib.util.find_spec(part) is None:
        raise ServiceFailed(
            f"{needed_for} needs the package {part.replace('_', '-')}, which is not installed.",
            f"Install all packages ({ALL_PARTS}), or give the address of a server with --server.",
        )


def exec_module(module: str, *arguments: str) -> NoReturn:
    """Replace this process by `python -m module`, so that signals and the exit code are those of that program."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])

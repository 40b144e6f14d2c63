"""Calls of the command line: in this process, or as a process of its own."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner, Result

from splatmill.cli.app import app

WIDE = {"COLUMNS": "250", "TERM": "dumb", "NO_COLOR": "1"}


def invoke(*arguments: str | Path, typed: str | None = None) -> Result:
    """Run a command in this process. `typed` is its standard input, which is no terminal."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], input=typed, env=WIDE)


def spawn(*arguments: str | Path, **settings) -> subprocess.Popen[str]:
    """Start a command as a process."""
    command = [sys.executable, "-m", "splatmill", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | settings
    # A runner in the background of a shell ignores Ctrl-C, and its children would inherit that.
    return subprocess.Popen(command, env=os.environ | WIDE, preexec_fn=_hear_interrupts, **pipes)


def on_terminal(*arguments: str | Path, columns: int = 80, typed: str = "") -> tuple[int, str]:
    """Run a command on a terminal of this width, and type; return its exit status, and what the terminal received."""
    import fcntl
    import pty
    import struct
    import termios

    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    command = [sys.executable, "-m", "splatmill", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment | {"TERM": "xterm"}
    )
    os.close(theirs)
    os.write(ours, typed.encode())
    shown = b""
    try:
        while chunk := os.read(ours, 65536):
            shown += chunk
    except OSError:
        pass  # how Linux says that the other side of a terminal is closed
    os.close(ours)
    return process.wait(), shown.decode().replace("\r\n", "\n")


def _hear_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

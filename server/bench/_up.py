"""`splatmill up` for the time of a benchmark."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import psutil

_STOP_SECONDS = 60.0


@contextmanager
def served(folder: Path, settings: Mapping[str, str] | None = None) -> Iterator[tuple[str, psutil.Process]]:
    """Run the service with its data in a folder, and yield its address and its process.

    settings: environment variables; those of this process that set something of Splatmill are left out.
    """
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("SPLATMILL_") and name != "REDIS_URL"
    } | dict(settings or {})
    program = [sys.executable, "-m", "splatmill_server.up", "--json-ready", "--port", "0"]
    with (folder / "up.log").open("w") as log:
        up = subprocess.Popen(
            [*program, "--data", str(folder / "data")],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    assert up.stdin is not None
    assert up.stdout is not None
    line = up.stdout.readline()
    if not line:
        raise SystemExit((folder / "up.log").read_text())
    try:
        yield json.loads(line)["url"], psutil.Process(up.pid)
    finally:
        up.stdin.close()
        up.wait(_STOP_SECONDS)
        up.stdout.close()

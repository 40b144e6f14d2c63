"""Starts the renderer: `python -m splatmill_worker renderer`."""

import os
import socket
import sys
from pathlib import Path

import uvicorn

from splatmill.backplane import log_lines, rendering
from splatmill.backplane.private_files import listen
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import parse_bytes
from splatmill_worker.render_service.app import RenderApp
from splatmill_worker.settings import log_format, storage_url, umask

MAX_CACHE_BYTES = 1 << 30
"""Largest default for the memory of cached models; machines with little memory use an eighth of it."""


def serve(host: str, port: int, uds: Path | None, fd: int | None = None, backend: str | None = None) -> int:
    """Serve until a signal to stop. Return the exit status.

    host, port: the address to listen on; `uds`, the path of a unix socket, takes its place.
    fd: the descriptor of a socket that listens already, in place of both.
    backend: the kernels to render with; None means those of the CPU.

    SPLATMILL_RENDER_CACHE, a size such as 500MB, limits the memory of cached models.
    """
    try:
        log_lines.configure(log_format())
        os.umask(umask())
        app = RenderApp(Storage(storage_url(), read_only=True), _cache_bytes(), backend)
        if fd is not None:
            listener: socket.socket | None = socket.socket(fileno=fd)
        else:
            listener = listen(uds, "choose another path with --uds.") if uds is not None else None
    except (StorageError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    config = uvicorn.Config(
        app.asgi(),
        host=host,
        port=port,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=2,
        timeout_keep_alive=rendering.IDLE_TIMEOUT,
        lifespan="off",
    )
    server = uvicorn.Server(config)
    server.run(sockets=None if listener is None else [listener])
    if uds is not None:
        uds.unlink(missing_ok=True)
    return 0 if server.started else 1


def _cache_bytes() -> int:
    """Bytes of memory for cached models. Raises ValueError where SPLATMILL_RENDER_CACHE is not a size."""
    text = os.environ.get("SPLATMILL_RENDER_CACHE")
    if not text:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        return min(MAX_CACHE_BYTES, memory // 8)
    try:
        return int(parse_bytes(text))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"SPLATMILL_RENDER_CACHE cannot be used: {error}.") from error

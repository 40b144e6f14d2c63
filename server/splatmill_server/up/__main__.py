"""`python -m splatmill_server.up`, the program behind `splatmill up`."""

import argparse
import errno
import ipaddress
import json
import os
import socket
import sys
from pathlib import Path

from splatmill.backplane.private_files import PRIVATE, exposure, parse_mask
from splatmill.schema.port import DEFAULT_PORT
from splatmill_server.up.folder import DataFolder, UpError
from splatmill_server.up.supervisor import Supervisor


def main(argv: list[str] | None = None) -> int:
    """Run the service until Ctrl-C, and return the exit status."""
    chosen = _parser().parse_args(argv)
    key = os.environ.get("SPLATMILL_API_KEY") or None
    try:
        mask = _mask()
        os.environ["SPLATMILL_ROOT_PATH"] = root_path = _root_path(chosen.root_path)
        with _listen(chosen.host, chosen.port, chosen.data) as listener:
            folder = DataFolder(chosen.data)
            if (exposed := exposure(folder.path, mask)) is not None:
                _print(exposed)
            try:
                url = _url(chosen.host, listener.getsockname()[1]) + root_path
                supervisor = Supervisor(folder, listener, _print)

                def ready() -> None:
                    if chosen.json_ready:
                        print(json.dumps({"url": url, "api_key": key}), flush=True)
                    else:
                        _print(
                            f"Splatmill is ready at {url}\nData: {folder.path}\nStop it with "
                            f"Ctrl-C; unfinished jobs resume at the next start."
                        )

                supervisor.run(ready, until_closed=sys.stdin.fileno() if chosen.json_ready else None)
            finally:
                folder.close()
    except UpError as error:
        _print(str(error))
        return 1
    return 0


def _mask() -> int:
    """Set the mask of the modes of files that the service makes, and return it. Raises UpError."""
    try:
        mask = parse_mask(os.environ.get("SPLATMILL_UMASK") or f"{PRIVATE:03o}")
    except ValueError as error:
        raise UpError(f"SPLATMILL_UMASK: {error}.") from error
    os.umask(mask)
    return mask


def _root_path(text: str) -> str:
    """Return a root path without the slash at its end. Raises UpError for a text that is none."""
    from splatmill_server.base.root_path import checked

    try:
        return checked(text)
    except ValueError as error:
        raise UpError(f"--root-path: {error}.") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatmill up", description="Run the whole service on this machine."
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on (default: %(default)s); other machines need a key",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help="port to listen on; 0 takes any free port (default: %(default)s)",
    )
    parser.add_argument(
        "--data",
        type=Path,
        default=Path(os.environ.get("SPLATMILL_DATA") or "splatmill-data"),
        help="folder for all data (default: SPLATMILL_DATA, else splatmill-data)",
    )
    parser.add_argument(
        "--root-path",
        default=os.environ.get("SPLATMILL_ROOT_PATH") or "",
        help="path below which a proxy publishes the service, such as /splats (default: SPLATMILL_ROOT_PATH)",
    )
    parser.add_argument(
        "--json-ready",
        action="store_true",
        help="for programs: print one line of JSON (url, api_key) when ready, and stop when standard "
        "input closes",
    )
    return parser


def _listen(host: str, port: int, data: Path) -> socket.socket:
    """Return the listening socket. Raises UpError for a port in use, and for a public address without a key."""
    if not 0 <= port <= 65535:
        # getaddrinfo takes the port modulo 65536
        raise UpError(
            f"There is no port {port}. Choose one from 1 to 65535 with --port, or 0 for any free port."
        )
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise UpError(f"Cannot listen on {host}:{port}: {error}. Choose another --host or --port.") from error
    family, kind, protocol, _, address = addresses[0]
    _check_exposure(str(address[0]).partition("%")[0], data)
    listener = socket.socket(family, kind, protocol)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise UpError(
                f"Port {port} on {host} is in use by another program. Choose another with --port "
                "(--port 0 takes any free port)."
            ) from error
        raise UpError(f"Cannot listen on {host}:{port}: {error}. Choose another --host or --port.") from error
    return listener


def _check_exposure(address: str, data: Path) -> None:
    """Raise UpError if other machines could reach a server without keys."""
    if ipaddress.ip_address(address).is_loopback:
        return
    from splatmill.backplane.connection import connect
    from splatmill.backplane.storage.storage import Storage, StorageError
    from splatmill_server.access.exposure import check_exposure
    from splatmill_server.access.keys import Keys
    from splatmill_server.base.settings import Settings

    try:
        settings = Settings(data=data, host=address)
        # Only whether there are keys is read, for which no connection is opened.
        keys = Keys(Storage(settings.storage), connect(), bootstrap=settings.api_key is not None)
        check_exposure(settings, keys)
    except (ValueError, StorageError) as error:
        raise UpError(str(error)) from error


def _url(host: str, port: int) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m splatmill_server.up`, the program behind `splatmill up`."""

import argparse
import errno
import ipaddress
import json
import os
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from splatmill.backplane.private_files import PRIVATE, exposure, parse_mask
from splatmill.schema.port import DEFAULT_PORT
from splatmill_server.up.folder import DataFolder, UpError
from splatmill_server.up.supervisor import Supervisor

if TYPE_CHECKING:
    from splatmill_server.access.keys import Keys
    from splatmill_server.up.lan import Lan

_HOST = "127.0.0.1"
"""The address to listen on where none is given."""


def main(argv: list[str] | None = None) -> int:
    """Run the service until Ctrl-C, and return the exit status."""
    chosen = _parser().parse_args(argv)
    try:
        mask = _mask()
        os.environ["SPLATMILL_ROOT_PATH"] = root_path = _root_path(chosen.root_path)
        lan = _prepare_lan(chosen) if chosen.lan else None
        with _listen(chosen.host, chosen.port, chosen.data) as listener:
            folder = DataFolder(chosen.data)
            if (exposed := exposure(folder.path, mask)) is not None:
                _print(exposed)
            try:
                port = listener.getsockname()[1]
                url = (_url(chosen.host, port) if lan is None else lan.url(port)) + root_path
                if lan is not None:
                    os.environ["SPLATMILL_LAN_URL"] = url
                supervisor = Supervisor(folder, listener, _print, renders_late=chosen.json_ready)

                def ready() -> None:
                    key = os.environ.get("SPLATMILL_API_KEY") or None
                    if chosen.json_ready:
                        print(json.dumps({"url": url, "api_key": key}), flush=True)
                    else:
                        _print(
                            f"Splatmill is ready at {url}\nData: {folder.path}\nStop it with "
                            f"Ctrl-C; unfinished jobs resume at the next start."
                        )
                        if lan is not None:
                            _print(lan.sentences(url, port))

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
        default=_HOST,
        help="address to listen on (default: %(default)s); other machines need a key",
    )
    parser.add_argument(
        "--lan",
        action="store_true",
        help="let devices of the local network use the service: over HTTPS and with a key, which are made and printed "
        "with a QR code for phones",
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


def _prepare_lan(chosen: argparse.Namespace) -> "Lan":
    """Return what `--lan` opens, and set the environment of the service for it. Raises UpError."""
    from splatmill_server.up import lan

    if chosen.host != _HOST:
        raise UpError("--lan listens in all networks of this machine. Leave out --host, or --lan.")
    chosen.host = lan.HOST
    opened = lan.prepare(chosen.data, has_keys=_keys(chosen.data).any())
    if opened.key is not None:
        os.environ["SPLATMILL_API_KEY"] = opened.key
    os.environ["SPLATMILL_TLS_CERTIFICATE"] = str(opened.certificate.file)
    os.environ["SPLATMILL_TLS_KEY"] = str(opened.certificate.key)
    return opened


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
    from splatmill.backplane.storage.storage import StorageError
    from splatmill_server.access.exposure import check_exposure
    from splatmill_server.base.settings import Settings

    try:
        check_exposure(Settings(data=data, host=address), _keys(data))
    except (ValueError, StorageError) as error:
        raise UpError(str(error)) from error


def _keys(data: Path) -> "Keys":
    """Return the stored keys. Raises UpError if they cannot be read."""
    from splatmill.backplane.connection import connect
    from splatmill.backplane.storage.storage import Storage, StorageError
    from splatmill_server.access.keys import Keys
    from splatmill_server.base.settings import Settings

    try:
        settings = Settings(data=data)
        # Only whether there are keys is read, for which no connection is opened.
        keys = Keys(Storage(settings.storage), connect(), bootstrap=settings.api_key is not None)
        keys.read()
    except (ValueError, StorageError) as error:
        raise UpError(str(error)) from error
    return keys


def _url(host: str, port: int) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    scheme = "https" if os.environ.get("SPLATMILL_TLS_CERTIFICATE") else "http"
    return f"{scheme}://[{shown}]:{port}" if ":" in shown else f"{scheme}://{shown}:{port}"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m splatmill_server`: serve the API as the environment says, or the options given here."""

import argparse
import logging
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

import structlog
import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from splatmill.backplane.storage import StorageError
from splatmill_server.app import create_app
from splatmill_server.settings import Settings

log = structlog.get_logger()

GRACE_SECONDS = 5
"""How long requests under way may take to end after a signal to stop."""


class Server(uvicorn.Server):
    """Tells the app at the first signal, so that event streams end instead of using up the grace."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        # uvicorn's own would raise the signal again after a clean end, and nothing after `run` would happen.
        self._app.state.service.closing.set()
        self.force_exit = self.should_exit and sig == signal.SIGINT
        self.should_exit = True


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal. Returns the exit status: 0, or 2 after a sentence about what has to be mended."""
    given = vars(_options().parse_args(arguments))
    configure_logging()
    try:
        settings = Settings(**{name: value for name, value in given.items() if value is not None})
        app = create_app(settings)
        listener = listen(settings)
    except ValidationError as error:
        for found in error.errors():
            print(f"splatmill_server: {_sentence(found)}", file=sys.stderr)
        return 2
    except (StorageError, OSError) as error:
        print(f"splatmill_server: {error}", file=sys.stderr)
        return 2
    config = uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=GRACE_SECONDS)
    log.info("serving", address=_address(listener), storage=settings.storage)
    server = Server(config, app)
    server.run(sockets=[listener])
    if settings.uds is not None:
        settings.uds.unlink(missing_ok=True)
    return 0 if server.started else 1


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m splatmill_server",
        description="Serve the Splatmill API.",
        epilog="Everything else is set by environment variables: REDIS_URL and "
        + ", ".join(f"SPLATMILL_{name.upper()}" for name in Settings.model_fields if name != "redis_url"),
    )
    for name in ("host", "port", "uds"):
        parser.add_argument(f"--{name}", help=Settings.model_fields[name].description)
    return parser


def listen(settings: Settings) -> socket.socket:
    """The socket to serve on. Raises OSError with a sentence when the address cannot be had."""
    if settings.uds is not None:
        return _listen_unix(settings.uds)
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise OSError(
            f"The address {settings.host}:{settings.port} cannot be listened on: {error.strerror}. "
            "Stop what uses it, or set SPLATMILL_PORT to another port (0 takes any free one)."
        ) from error
    return listener


def _listen_unix(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    probe = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        probe.connect(str(path))
    except OSError:
        path.unlink(missing_ok=True)  # Left over from a server that was killed; nobody answers there.
    else:
        listener.close()
        raise OSError(f"Another server answers on {path}; stop it, or set SPLATMILL_UDS to another path.")
    finally:
        probe.close()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        listener.bind(str(path))
        path.chmod(0o600)
    except OSError as error:
        listener.close()
        raise OSError(f"The socket {path} cannot be made: {error.strerror or error}.") from error
    return listener


def configure_logging(level: int = logging.INFO) -> None:
    """Lines for people on a terminal, JSON otherwise; uvicorn's own messages in the same form."""
    shared: list[structlog.types.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    people = sys.stderr.isatty()
    renderer: structlog.types.Processor = (
        # Plain traces: the rich ones print every local variable, keys included.
        structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
        if people
        else structlog.processors.JSONRenderer()
    )
    errors = [] if people else [structlog.processors.format_exc_info]
    structlog.configure(
        processors=[*shared, *errors, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(processors=[*errors, renderer], foreign_pre_chain=shared)
    )
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)


def _address(listener: socket.socket) -> str:
    name = listener.getsockname()
    return f"http://{name[0]}:{name[1]}" if isinstance(name, tuple) else f"unix:{name}"


def _sentence(found: object) -> str:
    assert isinstance(found, dict)
    text = str(found["msg"]).removeprefix("Value error, ")
    where = ".".join(str(part) for part in found["loc"])
    return f"SPLATMILL_{where.upper()}: {text}" if where else text


if __name__ == "__main__":
    sys.exit(main())

"""`python -m splatmill_server`: serves the API, configured by environment variables and command-line options."""

import argparse
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import FrameType

import structlog
import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from splatmill.backplane import private_files
from splatmill.backplane.connection import InvalidRedisUrl
from splatmill.backplane.log_lines import LogFormat
from splatmill.backplane.redact import redacted
from splatmill.backplane.rendering import IDLE_TIMEOUT
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill_server.access.exposure import NeedsKey
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from splatmill_server.base.tls import uvicorn_options

log = structlog.get_logger()

GRACE_SECONDS = 5
"""Seconds for which running requests may continue after a signal to stop."""

_OPEN_FILES = 65536
"""Number of files that the server opens at most, where the machine permits it."""


class Server(uvicorn.Server):
    """A server that informs the app of the first signal, so that event streams end before the grace period does.

    The headers of proxies are left to the app.
    """

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        config.proxy_headers = False
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        # uvicorn's own method raises the signal again after `run`, so the code after `run` would not be reached.
        self._app.state.service.closing.set()
        self.force_exit = self.should_exit and sig == signal.SIGINT
        self.should_exit = True


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal arrives. Return the exit status: 0, 1 if the start failed, 2 for invalid settings."""
    arguments_by_name = vars(_options().parse_args(arguments))
    configure_logging()
    allow_open_files()
    try:
        settings = Settings(**{name: value for name, value in arguments_by_name.items() if value is not None})
        configure_logging(settings.log_format)
        os.umask(settings.file_mask)
        tls_options = uvicorn_options(settings)
        app = create_app(settings)
        listener = listen(settings)
    except ValidationError as error:
        for fault in error.errors():
            print(f"splatmill_server: {_sentence(fault)}", file=sys.stderr)
        return 2
    except (StorageError, OSError, InvalidRedisUrl, NeedsKey) as error:
        print(f"splatmill_server: {error}", file=sys.stderr)
        return 2
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=GRACE_SECONDS,
        timeout_keep_alive=IDLE_TIMEOUT,
        **tls_options,
    )
    log.info("serving", address=_address(listener), storage=redacted(settings.storage))
    _check_modes(app.state.service.storage, settings)
    server = Server(config, app)
    server.run(sockets=[listener])
    if settings.uds is not None:
        settings.uds.unlink(missing_ok=True)
    return 0 if server.started else 1


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m splatmill_server",
        description="Serve the Splatmill REST API.",
        epilog="All other settings are environment variables: REDIS_URL, FORWARDED_ALLOW_IPS and "
        + ", ".join(
            f"SPLATMILL_{name.upper()}"
            for name, field in Settings.model_fields.items()
            if field.validation_alias is None
        ),
    )
    for name in ("host", "port", "uds", "root_path"):
        parser.add_argument(f"--{name.replace('_', '-')}", help=Settings.model_fields[name].description)
    return parser


def _check_modes(storage: Storage, settings: Settings) -> None:
    """Log which folders other users of the machine may read, and close that with secrets."""
    for folder in (settings.data.expanduser().absolute(), storage.root):
        exposed = private_files.exposure(folder, settings.file_mask) if folder is not None else None
        if exposed is not None:
            log.warning(exposed)
    private_files.close(storage.local_path(layout.webhooks()), settings.file_mask)


def listen(settings: Settings) -> socket.socket:
    """Return the listening socket. Raises OSError, with a sentence, if the address is not available."""
    if settings.uds is not None:
        return private_files.listen(settings.uds, "set SPLATMILL_UDS to another path.")
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise OSError(
            f"Cannot listen on {settings.host}:{settings.port}: {error.strerror}. "
            "Stop the program that uses the port, or set SPLATMILL_PORT to another one (0 takes "
            "any free port)."
        ) from error
    return listener


class _LineLog(structlog.PrintLogger):
    """A log of lines. One that cannot be written is left out: a full disk of the log must not fail every request."""

    def msg(self, message: str) -> None:
        with suppress(OSError):
            super().msg(message)

    log = debug = info = warn = warning = fatal = failure = err = error = critical = exception = msg


def allow_open_files() -> None:
    """Let this process open as many files as it may: each client that follows events holds a connection."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = _OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < target:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))


def configure_logging(chosen: LogFormat | None = None, level: int = logging.INFO) -> None:
    """Log in this format, also uvicorn's messages; by default, readable lines on a terminal and JSON otherwise."""
    shared: list[structlog.types.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    text = sys.stderr.isatty() if chosen is None else chosen == "text"
    renderer: structlog.types.Processor = (
        # Rich tracebacks would print all local variables, including keys.
        structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
        )
        if text
        else structlog.processors.JSONRenderer()
    )
    errors = [] if text else [structlog.processors.format_exc_info]
    structlog.configure(
        processors=[*shared, *errors, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *_: _LineLog(sys.stderr),
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(processors=[*errors, renderer], foreign_pre_chain=shared)
    )
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)


def _address(listener: socket.socket) -> str:
    name = listener.getsockname()
    return f"http://{name[0]}:{name[1]}" if isinstance(name, tuple) else f"unix:{name}"


def _sentence(value: object) -> str:
    assert isinstance(value, dict)
    text = str(value["msg"]).removeprefix("Value error, ")
    where = ".".join(str(part) for part in value["loc"])
    return f"SPLATMILL_{where.upper()}: {text}" if where else text


if __name__ == "__main__":
    sys.exit(main())

"""The embedded service: the whole service as a child process, for the duration of one command."""

import json
import os
import secrets
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import FrameType

from splatmill.cli.display.follow import ONE_SIGNAL_SECONDS
from splatmill.cli.local.programs import require
from splatmill.errors import ServiceFailed

SUPERVISOR = "splatmill_server.up"
START_SECONDS = 90.0  # a first start may read several hundred megabytes of libraries from disk
STOP_SECONDS = 45.0  # a worker that is stopped first writes a checkpoint, and then Redis is stopped


@dataclass(frozen=True)
class ServiceAddress:
    """The address of the service, and its API key if it requires one."""

    url: str
    api_key: str | None


@contextmanager
def embedded_service(data: Path, lock: int) -> Iterator[ServiceAddress]:
    """Run the service while the context is open, with its files in the folder `data`, which is kept.

    A job that runs at the end saves its state, and continues when the service is started on the same folder again.

    lock: file descriptor of the folder's lock (`folder_lock`). The service inherits it, so that the folder stays locked
        until the service has ended, also when this process is killed.

    Raises ServiceFailed, with the end of the service's log, if it does not start.
    """
    for part in ("splatmill_server", "splatmill_worker"):
        require(part, "Training on this machine")
    log = data / "service.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", SUPERVISOR, "--json-ready", "--port", "0", "--data", str(data)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=_environment(),
            pass_fds=(lock,),
            # Ctrl-C must reach this process only, which decides what becomes of the job.
            start_new_session=True,
        )
    try:
        import_module("splatmill.sdk.client")  # while the service starts: either takes a part of a second
        yield _wait_ready(process, log)
    finally:
        with _signals_hasten(process):
            _stop(process)


@contextmanager
def _signals_hasten(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """While the service stops, pass a signal to it: it then stops without writing a checkpoint.

    The training loses what it has done since its last checkpoint.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    began = time.monotonic()

    def hasten(number: int, frame: FrameType | None) -> None:
        if time.monotonic() - began > ONE_SIGNAL_SECONDS:
            process.terminate()

    before = {number: signal.signal(number, hasten) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _environment() -> dict[str, str]:
    """Return the environment for the service: without the addresses of another one, and with a random API key.

    With the Redis of another service, its workers could take the job of this command, and this machine its jobs. The
    key keeps other users of this machine out.
    """
    foreign = ("REDIS_URL", "SPLATMILL_STORAGE", "SPLATMILL_DATA", "SPLATMILL_RENDERER_URL", "SPLATMILL_UDS")
    kept = {name: value for name, value in os.environ.items() if name not in foreign}
    return kept | {"SPLATMILL_API_KEY": secrets.token_urlsafe(24)}


def _wait_ready(process: subprocess.Popen[bytes], log: Path) -> ServiceAddress:
    assert process.stdout is not None
    deadline = time.monotonic() + START_SECONDS
    line = b""
    while not line.endswith(b"\n"):
        left = deadline - time.monotonic()
        if left <= 0:
            raise ServiceFailed(
                f"The service did not start within {START_SECONDS:.0f} seconds.{_log_end(log)}"
            )
        if select.select([process.stdout], [], [], left)[0]:
            more = os.read(process.stdout.fileno(), 65536)
            if not more:
                code = process.wait()
                raise ServiceFailed(
                    f"The service ended while it started, with exit code {code}.{_log_end(log)}"
                )
            line += more
    try:
        ready = json.loads(line.splitlines()[0])
        return ServiceAddress(ready["url"], ready.get("api_key"))
    except (ValueError, KeyError) as error:
        raise ServiceFailed(f"The service printed {line[:200]!r} instead of its address.") from error


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Stop the service by closing its standard input; terminate it if it does not end in time."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    process.stdout.close()


def _log_end(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()[-8:]
    return "\nThe end of its log:\n  " + "\n  ".join(lines) if lines else ""

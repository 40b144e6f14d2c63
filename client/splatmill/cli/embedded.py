"""The whole service as a child process, for the time of one call."""

import importlib.util
import json
import os
import secrets
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatmill.errors import ServiceFailed

SUPERVISOR = "splatmill_server.up"
START_WITHIN = 90.0  # seconds; a first start on a cold disk reads a few hundred megabytes of libraries
END_WITHIN = 20.0  # seconds; a worker that is told to end writes its checkpoint first

ALL_PARTS = "pip install splatmill splatmill-server[embedded] splatmill-worker"


@dataclass(frozen=True)
class Service:
    """Where the service answers, and the key it asks for, if any."""

    url: str
    api_key: str | None


def require(part: str, needed_for: str) -> None:
    """ServiceFailed with the command that installs it, where a part is not installed."""
    if importlib.util.find_spec(part) is None:
        raise ServiceFailed(
            f"{needed_for} needs the part {part.replace('_', '-')}, which is not installed.",
            f"Install all parts ({ALL_PARTS}), or name a server with --server.",
        )


@contextmanager
def embedded_service(data: Path) -> Iterator[Service]:
    """Run the service with its files in `data`, an empty folder of its own, which is removed afterwards.

    Raises ServiceFailed, with what the service said, when it does not come up.
    """
    for part in ("splatmill_server", "splatmill_worker"):
        require(part, "Training on this machine")
    with _owned(data):
        log = data / "service.log"
        with log.open("wb") as errors:
            process = subprocess.Popen(
                [sys.executable, "-m", SUPERVISOR, "--json-ready", "--port", "0", "--data", str(data)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=_environment(),
                # Ctrl-C is for this process, which cancels the job first and ends the service after it.
                start_new_session=True,
            )
        try:
            yield _wait_ready(process, log)
        finally:
            _end(process)


def _environment() -> dict[str, str]:
    """This process's environment without what points at another service: its Redis would hand this call's job to
    strangers, and theirs to this machine. The key keeps other users of this machine out."""
    foreign = ("REDIS_URL", "SPLATMILL_STORAGE", "SPLATMILL_DATA", "SPLATMILL_RENDERER_URL", "SPLATMILL_UDS")
    kept = {name: value for name, value in os.environ.items() if name not in foreign}
    return kept | {"SPLATMILL_API_KEY": secrets.token_urlsafe(24)}


@contextmanager
def _owned(data: Path) -> Iterator[None]:
    """Hold `data` alone; what an earlier call left behind when it was killed is removed."""
    import fcntl  # not on Windows, where only `--server` works

    data.parent.mkdir(parents=True, exist_ok=True)
    lock_path = data.with_name(data.name + ".lock")
    with lock_path.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ServiceFailed(
                f"Another `splatmill train` is writing to {data.parent}.",
                "Choose another folder with -o, or wait.",
            ) from error
        shutil.rmtree(data, ignore_errors=True)
        data.mkdir()
        try:
            yield
        finally:
            shutil.rmtree(data, ignore_errors=True)
            lock_path.unlink(missing_ok=True)


def _wait_ready(process: subprocess.Popen[bytes], log: Path) -> Service:
    assert process.stdout is not None
    deadline = time.monotonic() + START_WITHIN
    line = b""
    while not line.endswith(b"\n"):
        left = deadline - time.monotonic()
        if left <= 0:
            raise ServiceFailed(
                f"The service did not come up within {START_WITHIN:.0f} seconds.{_last_words(log)}"
            )
        if select.select([process.stdout], [], [], left)[0]:
            more = os.read(process.stdout.fileno(), 65536)
            if not more:
                code = process.wait()
                raise ServiceFailed(f"The service ended at its start with code {code}.{_last_words(log)}")
            line += more
    try:
        ready = json.loads(line.splitlines()[0])
        return Service(ready["url"], ready.get("api_key"))
    except (ValueError, KeyError) as error:
        raise ServiceFailed(f"The service said {line[:200]!r} instead of where it answers.") from error


def _end(process: subprocess.Popen[bytes]) -> None:
    """Closing its input tells the service to end; what does not end in time is ended."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(END_WITHIN)
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    process.stdout.close()


def _last_words(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()[-8:]
    return "\nIts last words:\n  " + "\n  ".join(lines) if lines else ""

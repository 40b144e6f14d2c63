"""The service under test: `splatmill up`, a Redis behind a proxy, and, for S3, moto's server behind another."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import _s3_server
import httpx
import psutil
import redis

from _soak.clock import Clock
from _soak.orphans import Adoption
from _soak.processes import Member, Processes
from _soak.proxy import Proxy
from splatmill.backplane.connection import connect
from splatmill.backplane.queue import entries, leases
from splatmill.backplane.redis_program import find
from splatmill.backplane.storage.storage import Storage
from splatmill.process import die_with_parent, start_time

DISK_BYTES = 640 << 20
"""Size of the disk of the data folder, so that it can be filled: some 300 jobs leave a megabyte each."""

RESERVE_BYTES = 16 << 20
"""Bytes of that disk that uploads and workers leave free."""

_CLOCK_SECONDS = 5.0
"""Seconds by which a reading of two clocks may differ; the clock is set by more."""

_GONE_SECONDS = 10.0  # for the children of a killed process to end


class Service:
    """The processes on a folder of their own, which is deleted with them.

    folder: for all that is written.
    s3: whether storage is S3; otherwise a folder.
    patience: what all time limits are multiplied by, for a machine that has other work.
    processes: those of the service.
    disk: whether the data lies on a small disk of its own; None without the right to mount one.
    """

    def __init__(self, folder: Path, *, s3: bool, patience: float = 1.0) -> None:
        self.folder = folder
        self.patience = patience
        self.data = folder / "data"
        self.trace = folder / "trace.jsonl"
        self.trace.touch()
        self.data.mkdir(parents=True)
        self.clock = Clock(folder)
        self.disk = _mount(self.data)
        self._records: list[Any] = []
        self._read = 0
        self._adoption = Adoption()
        self.processes = Processes(self._own)
        self._ports = [_free_port() for _ in range(3)]
        self._redis: subprocess.Popen[bytes] | None = None
        self._up: subprocess.Popen[str] | None = None
        self.start_redis()
        self.redis_proxy = Proxy(("127.0.0.1", self._ports[0]))
        self.s3_proxy: Proxy | None = None
        self._s3: subprocess.Popen[bytes] | None = None
        self.environment = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("SPLATMILL_", "AWS_")) and name != "REDIS_URL"
        } | {
            "REDIS_URL": f"redis://127.0.0.1:{self.redis_proxy.port}/0",
            "SPLATMILL_PIPELINE": "_soak.pipeline",
            "SPLATMILL_DISK_RESERVE": str(RESERVE_BYTES),
            "SPLATMILL_MIN_FREE_BYTES": str(RESERVE_BYTES),
            "SOAK_TRACE": str(self.trace),
            "OMP_NUM_THREADS": "1",  # photos this small gain nothing by more, and threads wait for each other
            "PYTHONPATH": str(Path(__file__).resolve().parent.parent),
            **self.clock.environment,
        }
        self.storage_url = (self.data / "storage").as_uri()
        if s3:
            self._start_s3()
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self._ports[2]}", timeout=20, trust_env=False)
        self.processes.start()

    # Processes

    def start_redis(self) -> None:
        """Start Redis as `up` does, and wait until it answers."""
        place = self.data / "redis"
        place.mkdir(exist_ok=True)
        settings = {
            "port": str(self._ports[0]),
            "bind": "127.0.0.1",
            "dir": str(place),
            "appendonly": "yes",
            "appendfsync": "everysec",
            "aof-load-truncated": "yes",
            "save": "",
            "maxmemory-policy": "noeviction",
        }
        options = [part for name, value in settings.items() for part in (f"--{name}", value)]
        self._redis = self._popen([str(find().path), *options], "redis", os.environ | self.clock.environment)
        with self.redis() as connection:
            self.wait_for(lambda: _answers(connection.ping), 30, "Redis answers")

    def start(self) -> None:
        """Start `splatmill up`, and wait until it is ready."""
        parent = os.getpid()
        program = [sys.executable, "-m", "splatmill_server.up", "--json-ready"]
        with (self.folder / "up.log").open("a") as log:
            self._up = subprocess.Popen(
                [*program, "--port", str(self._ports[2]), "--data", str(self.data)],
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,
                preexec_fn=lambda: die_with_parent(parent),
            )
        assert self._up.stdout is not None
        if not self._up.stdout.readline():
            raise RuntimeError(f"The service did not start: {(self.folder / 'up.log').read_text()[-2000:]}")

    def stop(self) -> None:
        """Stop `up` as Ctrl-C does."""
        assert self._up is not None
        assert self._up.stdin is not None
        self._up.stdin.close()
        self._up.wait(60 * self.patience)
        assert self._up.stdout is not None
        self._up.stdout.close()
        self._up = None

    def close(self) -> None:
        """End everything and delete the data."""
        self.http.close()
        if self._up is not None:
            self.kill_up()
        self.processes.stop()
        for process in (self._redis, self._s3):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait(10)
        self.redis_proxy.close()
        if self.s3_proxy is not None:
            self.s3_proxy.close()
        self._adoption.end()
        if self.disk:
            subprocess.run(["umount", "--lazy", str(self.data)], check=False)
        shutil.rmtree(self.folder, ignore_errors=True)

    def running(self, role: str) -> list[Member]:
        """Return the processes of a role that run now."""
        return [member for member in self.processes.look() if member.role == role]

    def part(self, role: str) -> int:
        """Return the process id of a part of the service, such as the API, once it runs."""
        return int(self.wait_for(lambda: self.running(role), 20, f"there is a {role}")[0].pid)

    def jobs_held(self) -> set[str]:
        """Return the jobs that a worker holds: those that an attempt runs, or has run until its worker ended."""
        with self.redis() as connection:
            return {entries.split_rq_id(lease.entry)[0] for lease in leases.held(connection)}

    @property
    def redis_pid(self) -> int:
        assert self._redis is not None
        return self._redis.pid

    def left(self) -> list[int]:
        """Return the processes of the service that still run."""
        self.processes.look()
        return [member.pid for member in self.processes.members if member.runs]

    def orphans(self) -> list[int]:
        """Return the processes below this one that have lost their parent and run on."""
        own = [*self._own(), *([self._up.pid] if self._up is not None else [])]
        return self._adoption.orphans(own)

    def _own(self) -> list[int]:
        """Return the children of this process that are no part of the service: those from before, Redis and S3."""
        servers = [process.pid for process in (self._redis, self._s3) if process is not None]
        return [*self._adoption.own, *servers]

    def kill(self, *pids: int) -> None:
        """Kill processes, and wait until those below them are gone too. Raises AssertionError for one that stays."""
        below: dict[int, str | None] = {}
        for pid in pids:
            with suppress(psutil.Error):
                children = psutil.Process(pid).children(recursive=True)
                below |= {child.pid: start_time(child.pid) for child in children}
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.wait_for(
            lambda: all(start_time(pid) != began for pid, began in below.items() if began is not None),
            _GONE_SECONDS,
            f"the processes below {pids} are gone",
        )

    def kill_up(self) -> None:
        """Kill the supervisor alone. All below it must end."""
        assert self._up is not None
        self.kill(self._up.pid)
        self._forget_up()

    def kill_all(self) -> None:
        """Kill `up`, all below it, and Redis at once."""
        self.processes.look()
        family = [member.pid for member in self.processes.members if member.runs]
        self.kill(*family, self.redis_pid)
        assert self._redis is not None
        self._redis.wait(10)
        self._forget_up()

    def kill_redis(self, *, empty: bool = False) -> None:
        """Kill Redis. With `empty`, its data is lost."""
        assert self._redis is not None
        self._redis.kill()
        self._redis.wait(10)
        if empty:
            shutil.rmtree(self.data / "redis")

    # What a client and an operator see

    @contextmanager
    def redis(self) -> Iterator[redis.Redis]:
        """A connection past the proxy."""
        with connect(f"redis://127.0.0.1:{self._ports[0]}/0", timeout=10) as connection:
            yield connection

    def storage(self) -> Storage:
        """The storage past the proxy."""
        if self._s3 is None:
            return Storage(self.storage_url)
        os.environ.update(_s3_server.environment(self._ports[1]))
        return Storage(self.storage_url)

    def ready(self) -> bool:
        """Return whether the API answers, and finds Redis, storage and the renderer."""
        try:
            checks = self.http.get("/readyz", timeout=3).json()["checks"]
        except (httpx.HTTPError, ValueError, KeyError):
            return False
        return all(check == "ok" for check in checks.values())

    def records(self) -> list[Any]:
        """Return all lines of the pipelines' record (see `pipeline`)."""
        with self.trace.open("rb") as file:
            file.seek(self._read)
            fresh = file.read()
        whole = fresh[: fresh.rfind(b"\n") + 1]
        self._read += len(whole)
        self._records += [json.loads(line) for line in whole.splitlines()]
        return self._records

    def wait_for(self, condition: Callable[[], Any], seconds: float, what: str) -> Any:
        """Return the first true value of `condition`. Raises AssertionError after `seconds`, with its patience."""
        return wait_for(condition, seconds * self.patience, what)

    def sees_clock(self) -> bool:
        """Return whether the clock of Redis is off by as much as the injected one."""
        with self.redis() as connection:
            seconds, micros = connection.time()
        return abs(seconds + micros / 1e6 - time.time() - self.clock.offset) < _CLOCK_SECONDS

    def fill_disk(self) -> None:
        """Leave no byte free on the disk of the data folder."""
        with (self.data / "filler").open("wb", buffering=0) as file, suppress(OSError):
            while True:
                file.write(bytes(1 << 20))
        assert shutil.disk_usage(self.data).free < 1 << 20, "the disk is not full"

    def empty_disk(self) -> None:
        """Take back what `fill_disk` did."""
        (self.data / "filler").unlink(missing_ok=True)

    def _forget_up(self) -> None:
        assert self._up is not None
        self._up.wait(10)
        for stream in (self._up.stdin, self._up.stdout):
            assert stream is not None
            with suppress(OSError):
                stream.close()
        self._up = None

    def _start_s3(self) -> None:
        port = self._ports[1]
        self._s3 = self._popen(_s3_server.command(port), "s3", dict(os.environ))
        url = f"http://127.0.0.1:{port}/soak"
        self.wait_for(
            lambda: _answers(lambda: httpx.put(url, trust_env=False, timeout=60)), 60, "the S3 server answers"
        )
        self.s3_proxy = Proxy(("127.0.0.1", port))
        self.storage_url = "s3://soak/data"
        self.environment |= _s3_server.environment(self.s3_proxy.port) | {
            "SPLATMILL_STORAGE": self.storage_url
        }

    def _popen(self, command: list[str], name: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
        parent = os.getpid()
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=lambda: die_with_parent(parent),
            )


def wait_for(condition: Callable[[], Any], seconds: float, what: str) -> Any:
    """Return the first true value of `condition`. Raises AssertionError after `seconds`."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"After {seconds:g} s it does not hold that {what}.")
        time.sleep(0.02)
    return value


def _answers(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except (redis.RedisError, httpx.HTTPError):
        return False
    return True


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _mount(folder: Path) -> bool:
    """Mount a small disk of memory at a folder; return False where this user may not."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "splatmill-soak", str(folder)]
    try:
        return os.getuid() == 0 and subprocess.run(command, capture_output=True).returncode == 0
    except OSError:
        return False

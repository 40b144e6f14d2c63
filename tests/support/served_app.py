"""The real app in a real uvicorn with a real Redis. Tests play the worker by appending events, as a worker does."""

import contextlib
import json
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx
import redis
import uvicorn
from fastapi import FastAPI

from splatmill.backplane import lists
from splatmill.backplane.jobs import events, row
from splatmill.backplane.storage import layout
from splatmill.schema import DEFAULT_OWNER, Event, JobState, StateEvent, TrainOptions
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from splatmill_server.service import Service
from tests.support.waiting import wait_for


@dataclass
class ServedApp:
    """A served app: `http` to talk to it, `service` and `asgi` to look behind it, `address` for raw sockets."""

    http: httpx.Client
    service: Service
    address: tuple[str, int]
    settings: Settings
    redis: redis.Redis
    asgi: FastAPI
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
        record = row.read(self.redis, job_id)
        assert record is not None
        for event in said:
            number = self._attempts[job_id] if attempt is None else attempt
            events.append(self.redis, job_id, record.generation, number, event)

    def finish(self, job_id: str) -> None:
        """End a job with a small but whole model."""
        store_model(self.service, job_id)
        self.say(job_id, StateEvent(state=JobState.succeeded))

    def state(self, job_id: str) -> str:
        return str(self.http.get(f"/v1/jobs/{job_id}").json()["state"])


Serve = Callable[..., ServedApp]
"""Starts an app with the given settings; the fixture `serve` is one."""


@contextlib.contextmanager
def served_app(settings: Settings, connection: redis.Redis) -> Iterator[ServedApp]:
    """Serve the app in a thread on a free port."""
    app = create_app(settings)
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(
        uvicorn.Config(app, log_level="error", proxy_headers=False, timeout_graceful_shutdown=2)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_for(lambda: server.started)
    address = listener.getsockname()
    headers = {}
    if settings.api_key is not None:
        headers["Authorization"] = f"Bearer {settings.api_key.get_secret_value()}"
    try:
        base = f"http://{address[0]}:{address[1]}"
        # Without TLS no certificates are needed, and to load them takes longer than some tests.
        with httpx.Client(base_url=base, headers=headers, timeout=60, trust_env=False, verify=False) as http:
            yield ServedApp(http, app.state.service, address, settings, connection, app)
    finally:
        app.state.service.closing.set()
        server.should_exit = True
        thread.join(180)
        assert not thread.is_alive()
        listener.close()


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
    job = row.read(service.redis, job_id)
    owner = job.owner if job is not None else DEFAULT_OWNER
    moment = row.now().isoformat()
    record = {
        "id": job_id,
        "capture": "0" * 16,
        "name": name,
        "owner": owner,
        "state": "succeeded",
        "options": TrainOptions().model_dump(mode="json"),
        "created_at": moment,
        "finished_at": moment,
        "model": job_id,
        "generation": job.generation if job is not None else 1,
    }
    storage.put(layout.job_record(job_id), json.dumps(record).encode())
    lists.add_model(service.redis, job_id, row.now(), owner)


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


def raw(
    app: ServedApp,
    line: str,
    body: bytes,
    *headers: str,
    length: int | None = None,
    host: str = "localhost",
) -> tuple[int, bytes]:
    """Send a request as these bytes; status and body of the answer."""
    with socket.create_connection(app.address, 10) as link:
        head = [
            line,
            f"Host: {host}",
            "Connection: close",
            f"Content-Length: {length or len(body)}",
            *headers,
            "",
            "",
        ]
        link.sendall("\r\n".join(head).encode() + body)
        answer = b""
        while chunk := link.recv(65536):
            answer += chunk
    return int(answer.split()[1]), answer.partition(b"\r\n\r\n")[2]


def stored(app: ServedApp) -> list[str]:
    """Every file in storage. Folders may go while they are read, as the server removes them."""
    root = app.service.storage.root
    assert root is not None
    return sorted(
        os.path.relpath(os.path.join(folder, name), root)
        for folder, _, names in os.walk(root)
        for name in names
    )

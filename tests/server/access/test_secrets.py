"""Secrets planted in a real server are in none of its outputs: log, answers, doctor, storage and Redis.

The planted secrets: the key of the setting, a stored key (its secret before and after a rotation), the cookie of a
session, the password of Redis, and the secret key of a bucket. Not proved here: uvicorn's own messages on a crash.
"""

import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import httpx
import pytest
import redis

from splatmill.backplane.connection import connect
from splatmill_server.access.sessions import COOKIE
from tests.support.redis_server import RedisServer
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

API_KEY = "planted-api-key-71f3"
PASSWORD = "planted-redis-password-08c2"
BUCKET_SECRET = "planted-bucket-secret-5ea9"


@dataclass
class Watched:
    """Requests to a server, and everything that it answered, but for what it is asked to show once."""

    http: httpx.Client
    answers: list[str] = field(default_factory=list)

    def ask(
        self, method: str, path: str, *, key: str = API_KEY, shown: bool = True, **more: Any
    ) -> httpx.Response:
        headers = {"Authorization": f"Bearer {key}"} | more.pop("headers", {})
        answer = self.http.request(method, path, headers=headers, **more)
        self.http.cookies.clear()
        if shown:
            self.answers.append(f"{answer.status_code} {answer.headers} {answer.text}")
        return answer


def planted(tmp_path: Path, redis_url: str, **more: str) -> dict[str, str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("SPLATMILL_", "AWS_"))}
    return clean | {
        "REDIS_URL": redis_url,
        "SPLATMILL_API_KEY": API_KEY,
        "SPLATMILL_DATA": str(tmp_path / "data"),
        "SPLATMILL_UDS": str(tmp_path / "s"),
        "AWS_ACCESS_KEY_ID": "planted",
        "AWS_SECRET_ACCESS_KEY": BUCKET_SECRET,
        "AWS_REGION": "us-east-1",
        **more,
    }


@contextlib.contextmanager
def served(env: dict[str, str], log: Path) -> Iterator[Watched]:
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "splatmill_server"], env=env, stderr=file, stdout=file
        )
    transport = httpx.HTTPTransport(uds=env["SPLATMILL_UDS"], verify=False)
    try:
        with httpx.Client(transport=transport, base_url="http://localhost", timeout=60) as http:
            wait_for(lambda: listening(env["SPLATMILL_UDS"]), 60)
            yield Watched(http)
    finally:
        process.terminate()
        process.wait(30)


def listening(path: str) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(path) == 0


DOCTOR = """
from splatmill_worker.__main__ import main

main(["doctor"])
main(["doctor", "--json"])
"""


def doctor(env: dict[str, str]) -> str:
    """Its report as lines and as JSON. One process writes both: the import of torch takes longer than they."""
    command = [sys.executable, "-c", DOCTOR]
    ran = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    assert ran.stdout.rstrip().endswith("]"), ran
    return f"{ran.stdout}\n{ran.stderr}"


def contents(connection: redis.Redis) -> str:
    """Everything in Redis, as its own dump of each key."""
    return "".join(f"{name!r} {connection.dump(name)!r}" for name in connection.keys("*"))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[RedisServer]:
    """A Redis with a password."""
    server = RedisServer(tmp_path)
    server.start()
    server.connection.config_set("requirepass", PASSWORD)
    server.connection.close()
    yield server
    server.kill()


def test_no_output_shows_a_secret(store: RedisServer, tmp_path: Path) -> None:
    url = f"unix://:{PASSWORD}@{store.path}"
    connection = connect(url, retries=0)
    log = tmp_path / "log"
    env = planted(tmp_path, url)
    with served(env, log) as server:
        made = server.ask("POST", "/v1/keys", json={"name": "ann", "owner": "ann"}, shown=False).json()
        first = made["secret"]
        answer = server.ask("POST", "/v1/session", key=first, shown=False)
        cookie = SimpleCookie(answer.headers["set-cookie"])[COOKIE].value
        in_use = {"Authorization": "none", "Cookie": f"{COOKIE}={cookie}"}
        server.ask("GET", "/v1/me", headers=in_use)
        server.ask("POST", "/v1/captures", headers=in_use | {"Origin": "https://evil.example"})
        server.ask("POST", "/v1/captures", headers=in_use | {"Origin": "http://localhost"})
        for path in (
            "/v1/me",
            "/v1/keys",
            f"/v1/keys/{made['id']}",
            "/v1/info",
            "/metrics",
            "/readyz",
            "/docs",
        ):
            server.ask("GET", path)
            server.ask("GET", path, key=first)
        server.ask("GET", "/openapi.json")
        for wrong in (first[:-1], first.upper(), f"{API_KEY}x"):
            server.ask("GET", "/v1/jobs", key=wrong)
        server.ask("POST", "/v1/keys", content=b"{", headers={"Content-Type": "application/json"})
        server.ask("POST", "/v1/keys", json={"name": "x", "owner": "Not Valid"})
        server.ask("POST", "/v1/jobs", json={"capture": "none"}, key=first)
        second = server.ask("POST", f"/v1/keys/{made['id']}/rotate", shown=False).json()["secret"]
        server.ask("GET", "/v1/jobs", key=first)
        stored = "".join(
            path.read_text(errors="replace") for path in (tmp_path / "data").rglob("*") if path.is_file()
        )
        kept = contents(connection)
        assert made["id"] in stored
        assert "session" in kept
        connection.close()
        store.kill()
        for path in ("/v1/jobs", "/v1/me", "/readyz", "/metrics"):
            server.ask("GET", path, key=second)
        server.ask("GET", "/v1/me", headers=in_use)
    outputs = {
        "the log": log.read_text(),
        "an answer": "\n".join(server.answers),
        "the doctor": doctor(env),
        "storage": stored,
        "Redis": kept,
    }
    lines = [json.loads(line) for line in outputs["the log"].splitlines()]
    assert len([line for line in lines if line["event"] == "request"]) > 20
    assert "queue_unavailable" in outputs["an answer"]
    assert "Redis" in outputs["the doctor"]
    halves = {"the new secret": second, "the old secret": first, "the cookie": cookie}
    named = {"the API key": API_KEY, "the password": PASSWORD, "the bucket's": BUCKET_SECRET, **halves}
    # A stored secret may not appear without its prefix either.
    named |= {f"the random part of {what}": text.rsplit("_", 1)[-1] for what, text in halves.items()}
    for where, text in outputs.items():
        assert not [what for what, secret in named.items() if secret in text], where


def test_a_bucket_that_does_not_answer_shows_no_secret(tmp_path: Path, redis_url: str) -> None:
    env = planted(
        tmp_path, redis_url, SPLATMILL_STORAGE="s3://bucket/x", AWS_ENDPOINT_URL="http://127.0.0.1:1"
    )
    log = tmp_path / "log"
    with served(env, log) as server:
        assert server.ask("GET", f"/v1/captures/{'0' * 16}").status_code == 503
    text = log.read_text() + "".join(server.answers) + doctor(env)
    assert "Storage could not" in text
    for secret in (BUCKET_SECRET, API_KEY):
        assert secret not in text

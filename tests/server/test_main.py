"""`python -m splatmill_server` as a process: what it says when it cannot serve, and how it ends.

Not proved here: `splatmill up`, which starts Redis, the worker and the renderer as well (tests/service).
"""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.served_app import problem
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow


def command(**env: str) -> dict[str, Any]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SPLATMILL_")}
    return {"args": [sys.executable, "-m", "splatmill_server"], "env": clean | env, "text": True}


STARTS = """
import contextlib, io, json, os, sys
from splatmill_server.__main__ import main

clean = dict(os.environ)
for options, env in json.loads(sys.argv[1]):
    os.environ.clear()
    os.environ.update(clean | env)
    with contextlib.redirect_stderr(io.StringIO()) as said:
        status = main(options)
    print(json.dumps([status, said.getvalue()]))
"""
"""One process starts the server again and again: the imports take longer than all the starts."""


def refusals(*starts: tuple[list[str], dict[str, str]]) -> list[str]:
    """What the server says to each of these options and settings, which must be a sentence and no traceback."""
    asked = command()
    asked["args"] = [sys.executable, "-c", STARTS, json.dumps(starts)]
    done: subprocess.CompletedProcess[str] = subprocess.run(
        **asked, capture_output=True, timeout=60, check=True
    )
    ends = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(ends) == len(starts)
    for status, said in ends:
        assert status == 2, said
        assert "Traceback" not in said
    return [said for _, said in ends]


def test_a_refused_start_ends_the_program_with_a_sentence(tmp_path: Path) -> None:
    asked = command(SPLATMILL_HOST="0.0.0.0", SPLATMILL_DATA=str(tmp_path / "data"))
    done: subprocess.CompletedProcess[str] = subprocess.run(
        **asked, capture_output=True, timeout=60, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "SPLATMILL_API_KEY" in done.stderr
    assert "Traceback" not in done.stderr


def test_reasons_not_to_start_are_sentences(tmp_path: Path, redis_url: str) -> None:
    data = {"SPLATMILL_DATA": str(tmp_path / "data")}
    (tmp_path / "file").write_text("x")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        key, log, file, nowhere, no_port, renderer, allowed, in_use = refusals(
            (["--host", "0.0.0.0"], data),
            ([], data | {"SPLATMILL_LOG_FORMAT": "xml"}),
            ([], {"SPLATMILL_DATA": str(tmp_path / "file")}),
            ([], {"SPLATMILL_DATA": "/proc/splatmill"}),  # nobody, not even root, can make a folder there
            ([], data | {"SPLATMILL_PORT": "99999999"}),
            ([], data | {"SPLATMILL_RENDERER_URL": "ftp://x"}),
            ([], data | {"SPLATMILL_OUTGOING_ALLOW": "nas/share"}),
            (["--port", port], data | {"SPLATMILL_PORT": "0"}),
        )
    assert "SPLATMILL_API_KEY" in key
    assert "SPLATMILL_LOG_FORMAT" in log
    assert "cannot be created" in file
    assert "cannot be created" in nowhere
    assert "SPLATMILL_PORT" in no_port
    assert "SPLATMILL_RENDERER_URL" in renderer
    assert "SPLATMILL_OUTGOING_ALLOW: 'nas/share' is not a host" in allowed
    assert port in in_use
    assert "SPLATMILL_PORT" in in_use


@contextmanager
def served(uds: Path, **options: Any) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    """A server process on a unix socket. `log`: the file for its log, by default beside the socket."""
    env = options.pop("env")
    with options.pop("log", uds.with_suffix(".log")).open("w") as log:
        process = subprocess.Popen(**command(SPLATMILL_UDS=str(uds), **env), **options, stderr=log)
    transport = httpx.HTTPTransport(uds=str(uds), verify=False)
    try:
        with httpx.Client(transport=transport, base_url="http://localhost", timeout=30) as http:
            wait_for(lambda: process.poll() is None and listening(uds), 60)
            yield process, http
    finally:
        process.kill()
        process.wait()


def listening(uds: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(uds)) == 0


def test_one_signal_ends_it_with_a_stream_open(tmp_path: Path, redis_url: str) -> None:
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(tmp_path / "data")}
    uds = tmp_path / "s"
    with served(uds, env=env) as (process, http):
        assert oct(uds.stat().st_mode)[-3:] == "600"
        capture_id = http.post("/v1/captures", json={}).json()["id"]
        for name in ("a.jpg", "b.jpg"):
            http.put(f"/v1/captures/{capture_id}/images/{name}", content=name.encode())
        job_id = http.post("/v1/jobs", json={"capture": capture_id}).json()["id"]
        with http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
            stream = answer.iter_raw()
            assert b"retry" in next(stream)
            begun = time.monotonic()
            threading.Timer(0.1, process.send_signal, [signal.SIGTERM]).start()
            for _ in stream:
                pass
        assert process.wait(20) == 0
        assert time.monotonic() - begun < 5
        assert not uds.exists()
        log = uds.with_suffix(".log").read_text()
        assert json.loads(log.splitlines()[0])["event"] == "serving"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_on_a_full_disk_fails_no_request(tmp_path: Path, redis_url: str) -> None:
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(tmp_path / "data")}
    with served(tmp_path / "s", env=env, log=Path("/dev/full")) as (_, http):
        capture_id = http.post("/v1/captures", json={}).json()["id"]
        assert http.get(f"/v1/captures/{capture_id}").status_code == 200
        assert http.get("/v1/captures/none").status_code == 404


def limit_files() -> None:
    """No file over 2 MB for this process: the kernel refuses writes as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's file size limit")
def test_storage_that_fills_up_during_an_upload_is_507_and_loses_nothing(
    tmp_path: Path, redis_url: str
) -> None:
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(tmp_path / "data")}
    with served(tmp_path / "s", env=env, preexec_fn=limit_files) as (_, http):
        capture_id = http.post("/v1/captures", json={}).json()["id"]
        address = f"/v1/captures/{capture_id}/images"
        assert http.put(f"{address}/a.jpg", content=b"a" * 1_000_000).status_code == 201
        files = sorted(p for p in (tmp_path / "data").rglob("*") if p.is_file())
        answer = http.put(f"{address}/b.jpg", content=b"b" * 30_000_000)
        assert problem(answer, 507, "storage_full")["advice"]
        assert sorted(p for p in (tmp_path / "data").rglob("*") if p.is_file()) == files
        assert http.put(f"{address}/b.jpg", content=b"b" * 1_000_000).status_code == 201
        assert [f["name"] for f in http.get(f"/v1/captures/{capture_id}").json()["files"]] == [
            "a.jpg",
            "b.jpg",
        ]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_uploads_and_downloads_are_never_whole_in_memory(tmp_path: Path, redis_url: str) -> None:
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(tmp_path / "data")}
    with served(tmp_path / "s", env=env) as (process, http):
        capture_id = http.post("/v1/captures", json={}).json()["id"]
        before = peak(process.pid)
        chunk = os.urandom(1 << 20)
        answer = http.put(f"/v1/captures/{capture_id}/images/video.mp4", content=(chunk for _ in range(200)))
        assert answer.json()["size"] == 200 << 20
        assert peak(process.pid) - before < 100 << 20


def peak(pid: int) -> int:
    """Bytes of the largest resident size a process ever had."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) * 1024


def modes(folder: Path) -> dict[str, str]:
    """The modes of all folders and files in and below a folder, by kind."""
    paths = [folder, *folder.rglob("*")]
    return {
        kind: ",".join(sorted({f"{path.stat().st_mode & 0o777:o}" for path in paths if is_kind(path)}))
        for kind, is_kind in (("folders", Path.is_dir), ("files", Path.is_file))
    }


@pytest.mark.parametrize(("umask", "expected"), [("", ("700", "600")), ("027", ("750", "640"))])
def test_other_users_of_the_machine_may_read_no_file(
    tmp_path: Path, redis_url: str, umask: str, expected: tuple[str, str]
) -> None:
    data = tmp_path / "data"
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(data), "SPLATMILL_UMASK": umask}
    with served(tmp_path / "s", env=env) as (_, http):
        capture_id = http.post("/v1/captures", json={}).json()["id"]
        http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=b"photo").raise_for_status()
        http.post("/v1/webhooks", json={"url": "http://8.8.8.8/"}).raise_for_status()
        assert list((data / "storage" / "webhooks").iterdir())
        assert modes(data) == dict(zip(("folders", "files"), expected, strict=True))


def test_a_folder_that_is_open_to_others_is_named_at_the_start_and_its_secrets_are_closed(
    tmp_path: Path, redis_url: str
) -> None:
    storage = tmp_path / "data" / "storage"
    (storage / "webhooks").mkdir(parents=True)
    for above in (tmp_path, *tmp_path.parents):
        if above.stat().st_uid == os.geteuid() and "pytest" in str(above):
            above.chmod(0o755)  # pytest makes the folders that hold it for its user alone
    env = {"REDIS_URL": redis_url, "SPLATMILL_DATA": str(tmp_path / "data")}
    with served(tmp_path / "s", env=env) as (_, http):
        assert http.get("/healthz").status_code == 200
        log = (tmp_path / "s.log").read_text()
    for folder in (tmp_path / "data", storage):
        assert f"The folder {folder} has the mode 0755" in log
        assert f"chmod 0700 {folder}" in log
    assert storage.stat().st_mode & 0o777 == 0o755, (
        "a folder that the operator may have made is left as it is"
    )
    assert (storage / "webhooks").stat().st_mode & 0o777 == 0o700
    wrong = refusals(([], env | {"SPLATMILL_UMASK": "777"}), ([], env | {"SPLATMILL_UMASK": "rubbish"}))
    assert all("SPLATMILL_UMASK: " in said and "is not a mask; write 077" in said for said in wrong)

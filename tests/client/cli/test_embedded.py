"""The service for the time of one call: it comes up, keeps to itself, ends whole, and says why when it cannot start.
`splatmill train` loses nothing when it is interrupted, and the same command continues (with a stand-in pipeline).

Does not prove what the service does with a job; tests/service does. Here a job only has to reach its worker.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from splatmill import Client
from splatmill.cli.commands import service as commands
from splatmill.cli.exits import Exit
from splatmill.cli.local.embedded import ServiceAddress, embedded_service
from splatmill.cli.local.folder_lock import locked
from splatmill.errors import ServiceFailed, Unauthorized
from tests.support.command_line import invoke

pytestmark = pytest.mark.slow


@contextmanager
def service_on(data: Path) -> Iterator[ServiceAddress]:
    """The service on a folder, locked as `splatmill train` does."""
    data.mkdir(parents=True, exist_ok=True)
    with locked(data) as lock, embedded_service(data, lock) as service:
        yield service


def family() -> set[int]:
    return {child.pid for child in psutil.Process().children(recursive=True)}


def runs(pid: int) -> bool:
    """Whether a process is there and not merely waiting to be collected."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def test_it_comes_up_and_leaves_nothing(tmp_path: Path, monkeypatch):
    # What points at another service is not for this one.
    monkeypatch.setenv("REDIS_URL", "redis://127.0.0.1:9/0")
    monkeypatch.setenv("SPLATMILL_STORAGE", "s3://somebody-elses/bucket")
    before = family()
    data = tmp_path / "out" / ".splatmill"
    with service_on(data) as service:
        with Client(service.url, api_key=service.api_key) as client:
            assert client.ready().ready
            assert client.info().storage == "file"
        with Client(service.url) as stranger, pytest.raises(Unauthorized):
            stranger.info()
        with pytest.raises(ServiceFailed, match="Another `splatmill train`"), locked(data):
            pass
        children = family() - before
        assert len(children) >= 4, "supervisor, Redis, API, worker"
    assert not any(runs(pid) for pid in children)
    assert list((tmp_path / "out").iterdir()) == [data]


def test_a_start_that_fails_shows_the_end_of_its_log(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("splatmill.cli.local.embedded.SUPERVISOR", "splatmill_server.no_such_module")
    with (
        pytest.raises(ServiceFailed, match="ended while it started, with exit code 1") as failed,
        service_on(tmp_path / "d"),
    ):
        pass
    assert "no_such_module" in str(failed.value)


def test_it_ends_with_its_caller(tmp_path: Path):
    code = f"""
import json, os, psutil, sys
from pathlib import Path
from splatmill.cli.local.embedded import embedded_service
from splatmill.cli.local.folder_lock import locked
data = Path({str(tmp_path / "data")!r})
data.mkdir()
with locked(data) as lock, embedded_service(data, lock) as service:
    pids = [child.pid for child in psutil.Process().children(recursive=True)]
    print(json.dumps(pids), flush=True)
    os.kill(os.getpid(), 9)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    pids = json.loads(done.stdout)
    assert len(pids) >= 4
    with locked(tmp_path / "data"):  # the next command waits until the service of the killed one has ended
        assert not any(runs(pid) for pid in pids)


def test_photos_that_are_none_fail_with_a_sentence(tmp_path: Path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for n in range(3):
        (photos / f"{n}.jpg").write_text("this is not a photo, whatever its name says")
    command = [sys.executable, "-m", "splatmill", "train", str(photos), "-o", str(tmp_path / "out")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env=os.environ | {"NO_COLOR": "1"}
    )
    assert done.returncode == Exit.job_failed, done.stderr
    assert "\nError: " in done.stderr
    assert "Traceback" not in done.stderr
    assert "The training is kept in" in done.stderr


def test_up_becomes_the_supervisor_with_its_arguments(monkeypatch: pytest.MonkeyPatch):
    handed: list[tuple[str, ...]] = []
    monkeypatch.setattr(commands, "exec_module", lambda *words: handed.append(words))
    assert invoke("up", "--port", "1", "--data", "somewhere").exit_code == 0
    assert handed == [("splatmill_server.up", "--port", "1", "--data", "somewhere")]

"""Proves that an attempt stops before the worker's disk is full and continues later, and that a worker waits for space.

The free space is played, or the reserve is larger than any disk; no disk is filled here.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rq import Worker

from splatmill.backplane import keys
from splatmill.backplane.queue import entries, queue
from splatmill.backplane.storage.storage import Storage
from splatmill_worker.errors import DiskReserveReached
from splatmill_worker.service import disk_reserve
from splatmill_worker.service.job_folder import JobFolder
from tests.support.jobs import CAPTURE, read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.up import scripted, worker_environment
from tests.support.waiting import wait_for

JOB = "job00001"


def test_the_reserve_is_kept_on_the_disk_of_the_data_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "not" / "yet"))
    monkeypatch.setenv("SPLATMILL_DISK_RESERVE", "1kB")
    assert disk_reserve.shortage() is None
    needed = disk_reserve.shortage(10**18)
    assert needed is not None
    assert needed.problem().code == "worker_disk_full"
    monkeypatch.setenv("SPLATMILL_DISK_RESERVE", "1000000TB")
    assert disk_reserve.shortage() is not None
    assert "reserved (SPLATMILL_DISK_RESERVE)" in str(disk_reserve.shortage_text())


def test_copies_that_would_use_the_reserve_are_not_made(
    remote: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    monkeypatch.setenv("SPLATMILL_DISK_RESERVE", "1000000TB")
    with pytest.raises(DiskReserveReached) as reached:
        folder.stage_capture()
    assert reached.value.facts["needed"] > 0
    assert not folder.capture.exists()
    folder.close()


ATTEMPT = """
import json, sys
from pathlib import Path
from splatmill.backplane.connection import connect
from splatmill_worker.service import disk_reserve
from splatmill_worker.service.attempts.attempt import start_attempt
from splatmill_worker.service.attempts.run_attempt import run_attempt
from tests.support.servers import standin
url, entry, checkpoint, full_at = sys.argv[1:]
real = disk_reserve._free_bytes

def free(folder):
    step = json.loads(Path(checkpoint).read_text())["step"] if Path(checkpoint).is_file() else 0
    return 1000 if step >= int(full_at) else real(folder)

disk_reserve.CHECK_SECONDS, disk_reserve._free_bytes = 0.05, free
run_attempt(start_attempt(connect(url), entry, entry), lambda: standin.run, can_retry=True)
"""
"""Runs an attempt, whose disk becomes full when the stand-in has stored a step."""


@pytest.mark.slow
def test_an_attempt_stops_at_the_reserve_and_a_restart_goes_on(
    redis_server: RedisServer, tmp_path: Path
) -> None:
    connection = redis_server.connection
    storage = scripted(tmp_path, steps=60, pause=0.05)
    environment = worker_environment(redis_server, storage, tmp_path)
    checkpoint = tmp_path / "data" / "work" / JOB / "run" / "checkpoints" / "state.json"

    def attempt(generation: int, full_at: int) -> None:
        arguments = [redis_server.url, f"{JOB}-{generation}", str(checkpoint), str(full_at)]
        subprocess.run([sys.executable, "-c", ATTEMPT, *arguments], env=environment, check=True, timeout=60)

    write_row(connection, JOB)
    attempt(1, full_at=5)
    job = read_job(connection, JOB)
    assert job.state == "failed"
    assert job.problem is not None
    assert job.problem.code == "worker_disk_full"
    assert "continues from its last checkpoint" in str(job.problem.advice)
    stopped_at = json.loads(checkpoint.read_text())["step"]
    assert 5 <= stopped_at < 60
    connection.hset(keys.job(JOB), "generation", "2")
    attempt(2, full_at=1000)
    assert read_job(connection, JOB).state == "succeeded"
    attempts = [json.loads(line)["from"] for line in (tmp_path / "diary").read_text().splitlines()]
    assert attempts == [0, stopped_at]


@pytest.mark.slow
def test_a_worker_takes_no_jobs_while_its_disk_is_full_and_says_so(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    write_row(connection, JOB)
    queue.enqueue(connection, JOB, 1)
    environment = worker_environment(redis_server, storage, tmp_path, SPLATMILL_DISK_RESERVE="1000000TB")
    command = [sys.executable, "-m", "splatmill_worker", "train"]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as worker:
        wait_for(
            lambda: [
                each
                for each in Worker.all(connection=connection, serializer=entries.SERIALIZER)
                if each.get_state() == "suspended"
            ]
        )
        assert queue.status(connection, JOB, 1).state == "waiting"
        worker.terminate()
        _, said = worker.communicate(timeout=30)
    assert "takes no jobs: " in said
    assert worker.returncode == 0


def test_a_reserve_that_is_no_size_ends_the_worker_with_a_sentence(tmp_path: Path) -> None:
    environment = os.environ | {"SPLATMILL_DISK_RESERVE": "much", "SPLATMILL_DATA": str(tmp_path)}
    command = [sys.executable, "-m", "splatmill_worker", "train"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("SPLATMILL_DISK_RESERVE: 'much' is not a size")

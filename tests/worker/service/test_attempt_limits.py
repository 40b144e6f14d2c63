"""Proves that an attempt that runs too long or uses too much memory ends, by name and once, and its worker continues.

The processes are real. Control groups are read from files made here: making real ones needs rights that tests lack.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest
import redis

from splatmill.backplane.queue import queue
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Job, Role
from splatmill_worker import memory
from splatmill_worker.service import attempt_limits, command
from splatmill_worker.service.attempt_limits import Limits
from tests.support.jobs import messages, read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.up import running_worker, worker_environment
from tests.support.waiting import gone, wait_for

MIB = 2**20


@contextlib.contextmanager
def worker(server: RedisServer, storage: Storage, folder: Path, **settings: str) -> Iterator[int]:
    """A worker with these settings, which gives an attempt one second to save its state; yields its process id."""
    environment = worker_environment(server, storage, folder, **settings)
    with running_worker(environment, "--stop-grace", "1") as process:
        yield process.pid


def submit(connection: redis.Redis, storage: Storage, folder: Path, job_id: str, **script: object) -> None:
    """Enqueue a job on a capture of its own, whose name is that of the job."""
    script = {"steps": 1, "diary": str(folder / f"{job_id}.diary")} | script
    storage.put(layout.capture_file(job_id, Role.images, "script.json"), json.dumps(script).encode())
    write_row(connection, job_id, capture=job_id)
    assert queue.enqueue(connection, job_id, 1)


def ended(connection: redis.Redis, job_id: str) -> Job | None:
    job = read_job(connection, job_id)
    return job if job.state.final else None


def attempts(folder: Path, job_id: str) -> list[int]:
    """The processes of the attempts at a job."""
    return [json.loads(line)["pid"] for line in (folder / f"{job_id}.diary").read_text().splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("do", ["allocate", "allocate in a child"])
def test_an_attempt_that_takes_too_much_memory_fails_once_and_the_next_job_runs(
    redis_server: RedisServer, storage: Storage, tmp_path: Path, do: str
) -> None:
    connection = redis_server.connection
    submit(connection, storage, tmp_path, "greedy01", steps=3, do=do, at=2)
    submit(connection, storage, tmp_path, "modest01")
    with worker(redis_server, storage, tmp_path, SPLATMILL_MAX_MEMORY="600MB"):
        greedy = wait_for(partial(ended, connection, "greedy01"), 60)
        assert wait_for(partial(ended, connection, "modest01"), 60).state == "succeeded"
    assert greedy.problem is not None
    assert (greedy.problem.code, greedy.attempt) == ("out_of_memory", 1)
    assert greedy.problem.facts["limit_bytes"] == 600_000_000 < greedy.problem.facts["used_bytes"]
    assert "600.0 MB" in greedy.problem.detail
    assert "image_size" in str(greedy.problem.advice)
    assert gone(attempts(tmp_path, "greedy01"))
    assert queue.status(connection, "greedy01", 1).state == "failed"


@pytest.mark.slow
def test_an_attempt_that_runs_too_long_saves_its_state_and_fails_once(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    submit(connection, storage, tmp_path, "patient1", steps=1000, pause=0.05)
    with worker(redis_server, storage, tmp_path, SPLATMILL_MAX_RUN_TIME="2s"):
        job = wait_for(partial(ended, connection, "patient1"), 60)
    assert job.problem is not None
    assert (job.problem.code, job.attempt) == ("run_time_exceeded", 1)
    assert job.problem.facts == {"limit_seconds": 2.0}
    assert "checkpoint" in str(job.problem.advice)
    assert any(line.startswith("saved at step") for line in messages(connection, "patient1"))
    assert (tmp_path / "data/work/patient1/run/checkpoints/state.json").is_file()


@pytest.mark.slow
def test_an_attempt_that_does_not_listen_is_killed_after_the_grace(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    submit(connection, storage, tmp_path, "deaf0001", do="sleep", at=1)
    submit(connection, storage, tmp_path, "modest01")
    with worker(redis_server, storage, tmp_path, SPLATMILL_MAX_RUN_TIME="2s"):
        job = wait_for(partial(ended, connection, "deaf0001"), 60)
        assert gone(attempts(tmp_path, "deaf0001"))
        assert wait_for(partial(ended, connection, "modest01"), 60).state == "succeeded"
    assert job.problem is not None
    assert (job.problem.code, job.attempt) == ("run_time_exceeded", 1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="oom_score_adj is Linux's")
def test_the_kernel_would_kill_the_attempt_before_its_worker(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    submit(connection, storage, tmp_path, "patient1", steps=1000, pause=0.05)
    with worker(redis_server, storage, tmp_path) as pid:
        wait_for(lambda: (tmp_path / "patient1.diary").exists() and attempts(tmp_path, "patient1"))
        (attempt,) = attempts(tmp_path, "patient1")

        def score(process: int) -> int:
            return int(Path(f"/proc/{process}/oom_score_adj").read_text())

        assert score(attempt) >= attempt_limits.OOM_SCORE > score(pid)


def test_a_limit_that_cannot_be_read_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPLATMILL_MAX_RUN_TIME", "for ever")
    assert command.serve(None) == 1
    assert "SPLATMILL_MAX_RUN_TIME: 'for ever' is not a duration" in capsys.readouterr().err


def test_limits_of_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(memory, "_ROOT", tmp_path)
    usual = Limits.from_settings()
    assert usual.run_seconds == 48 * 3600
    assert usual.memory_bytes == int(memory.SHARE * psutil.virtual_memory().total)
    monkeypatch.setenv("SPLATMILL_MAX_RUN_TIME", "90m")
    monkeypatch.setenv("SPLATMILL_MAX_MEMORY", "2GiB")
    assert Limits.from_settings() == Limits(5400, 2 * 2**30)
    monkeypatch.setenv("SPLATMILL_MAX_RUN_TIME", "0")
    monkeypatch.setenv("SPLATMILL_MAX_MEMORY", "0")
    assert Limits.from_settings() == Limits(None, None)


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


@pytest.mark.skipif(sys.platform != "linux", reason="control groups are Linux's")
@pytest.mark.parametrize(
    ("files", "limit", "free"),
    [
        ({"proc/self/cgroup": "0::/\n"}, None, None),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/memory.max": "max\n"}, None, None),
        # Version 2: the tightest of a group and those around it; page cache does not count as used.
        (
            {
                "proc/self/cgroup": "0::/mill/worker\n",
                "sys/fs/cgroup/mill/worker/memory.max": "max\n",
                "sys/fs/cgroup/mill/memory.max": f"{512 * MIB}\n",
                "sys/fs/cgroup/mill/memory.current": f"{300 * MIB}\n",
                "sys/fs/cgroup/mill/memory.stat": f"anon 1\ninactive_file {200 * MIB}\n",
            },
            512 * MIB,
            412 * MIB,
        ),
        # Version 1, with the path that the group has outside of the container.
        (
            {
                "proc/self/cgroup": "5:cpu,cpuacct:/\n3:memory:/docker/abc\n",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": f"{256 * MIB}\n",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": f"{16 * MIB}\n",
            },
            256 * MIB,
            240 * MIB,
        ),
        (
            {
                "proc/self/cgroup": "3:memory:/\n",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n",
            },
            None,
            None,
        ),
    ],
)
def test_the_limits_of_control_groups(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    files: dict[str, str],
    limit: int | None,
    free: int | None,
) -> None:
    write(tmp_path, files)
    monkeypatch.setattr(memory, "_ROOT", tmp_path)
    assert memory.group_limit() == limit
    if limit is None:
        assert memory.attempt_limit() == int(memory.SHARE * psutil.virtual_memory().total)
    else:
        assert memory.attempt_limit() == int(memory.SHARE * limit)
        monkeypatch.setenv("SPLATMILL_MAX_MEMORY", "0")
        assert memory.available() == free
    # The plan of a training counts on no more than the attempt may use.
    monkeypatch.setenv("SPLATMILL_MAX_MEMORY", "1000")
    assert memory.available() == 0


def test_the_memory_of_a_process_counts_what_it_started() -> None:
    code = "import sys; kept = bytearray(b'x' * 200_000_000); print('ready', flush=True); sys.stdin.read()"
    before = memory.TreeMemory(os.getpid()).used()
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        process.stdout.readline()
        grown = memory.TreeMemory(os.getpid()).used() - before
        alone = memory.TreeMemory(process.pid).used()
    finally:
        process.stdin.close()
        process.wait(60)
        process.stdout.close()
    assert grown > 190_000_000
    assert 200_000_000 < alone < 400_000_000
    assert memory.TreeMemory(process.pid).used() == 0

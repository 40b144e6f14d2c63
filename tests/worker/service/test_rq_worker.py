"""Proves that a worker runs its own attempt function for every entry, and for none of a cancelled job.

Does not prove what happens to attempts that are killed, stopped or cancelled while they run: tests/service does.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any, cast

import pytest
from rq.job import Callback

from splatmill.backplane import keys, totals
from splatmill.backplane.jobs.row import now
from splatmill.backplane.queue import entries, leases, queue, rq_keys, workers
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Backend, Job, Role, TrainOptions
from splatmill_worker.service.rq_worker import AttemptWorker
from tests.support.jobs import CAPTURE, read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.servers import standin
from tests.support.servers.queue_entries import waiting
from tests.support.up import running_worker, scripted, worker_environment
from tests.support.waiting import wait_for

SHIFTED = """
import datetime, sys, time, rq.utils
real_time, real_now, ahead = time.time, rq.utils.now, float(sys.argv[1])
time.time = lambda: real_time() + ahead
rq.utils.now = lambda: real_now() + datetime.timedelta(seconds=ahead)
from splatmill_worker.__main__ import main
sys.exit(main(["train", *sys.argv[2:]]))
"""


@contextlib.contextmanager
def worker(
    server: RedisServer,
    storage: Storage,
    folder: Path,
    *options: str,
    clock_ahead: float = 0.0,
    stderr: IO[bytes] | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    """A worker whose clock is this many seconds ahead."""
    environment = worker_environment(server, storage, folder)
    program = ("-c", SHIFTED, str(clock_ahead))
    with running_worker(environment, *options, program=program, stderr=stderr) as process:
        yield process


def ended(server: RedisServer, job_id: str) -> Job | None:
    """The job once it has ended."""
    job = read_job(server.connection, job_id)
    return job if job.state.final else None


def test_the_function_and_callbacks_that_an_entry_names_are_never_imported(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    trace = tmp_path / "intruder was here"
    (tmp_path / "intruder.py").write_text(
        f"from pathlib import Path\nPath({str(trace)!r}).touch()\ndef called(*args): Path({str(trace)!r}).touch()\n"
    )
    functions = {
        "job00001": entries.ATTEMPT,
        "job00002": "splatmill_worker.pipeline.run",
        "job00003": "splatmill_worker.service.job.run_attempt",
        "job00004": "intruder.called",
        "job00005": "there.is.no.such.function",
    }
    for job_id, function in functions.items():
        write_row(redis_server.connection, job_id)
        entries.open_queue(redis_server.connection).enqueue_call(
            function,
            args=[job_id],
            job_id=entries.rq_id(job_id, 1),
            timeout=entries.JOB_TIMEOUT,
            on_success=Callback("intruder.called"),
            on_failure=Callback("intruder.called"),
        )

    def counted(end: str) -> int:
        return int(redis_server.connection.hget(keys.TOTALS, f"splatmill_attempts|{end}") or 0)

    with worker(redis_server, storage, tmp_path):
        jobs = {job_id: wait_for(partial(ended, redis_server, job_id)) for job_id in functions}
        wait_for(lambda: counted("reported") == len(functions))
        [listener] = workers.listening(redis_server.connection)
        assert listener.spare is not None
    assert float(redis_server.connection.hget(keys.TOTALS, totals.ATTEMPT_CPU.name) or 0) > 0
    assert {job_id: job.state for job_id, job in jobs.items()} == dict.fromkeys(functions, "succeeded")
    assert {job.attempt for job in jobs.values()} == {1}
    assert not trace.exists()


def test_log_lines_are_objects_that_name_worker_job_attempt_and_request(
    redis_server: RedisServer, storage: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second job has a script without a diary, at which the stand-in fails with a traceback of several lines."""
    monkeypatch.setenv("SPLATMILL_LOG_FORMAT", "json")
    connection = redis_server.connection
    storage.put(layout.capture_file("broken01", Role.images, "script.json"), b'{"steps": 1}')
    for job_id, capture in (("job00001", CAPTURE), ("job00002", "broken01")):
        write_row(connection, job_id, capture=capture, request=f"of {job_id}")
        assert queue.enqueue(connection, job_id, 1)
    with (tmp_path / "log").open("wb") as log, worker(redis_server, storage, tmp_path, stderr=log):
        ends = [wait_for(partial(ended, redis_server, job_id)).state for job_id in ("job00001", "job00002")]
        wait_for(lambda: (tmp_path / "log").read_text().count("has ended") == 2)
        wait_for(
            lambda: [connection.hget(key, "state") for key in connection.smembers("rq:workers")] == [b"idle"]
        )
    assert ends == ["succeeded", "failed"]
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert len({line["worker"] for line in lines if "worker" in line}) == 1
    for job_id in ("job00001", "job00002"):
        mine = [line for line in lines if line.get("job") == job_id]
        assert {line["request"] for line in mine} == {f"of {job_id}"}
        assert [line["attempt"] for line in mine if "begins" in line["event"]] == [1]
        assert mine[-1]["event"].endswith("has ended: reported")
    [failure] = [line for line in lines if line["event"] == "the attempt failed"]
    assert (failure["job"], failure["attempt"], failure["level"]) == ("job00002", 1, "error")
    assert failure["exception"].startswith("Traceback")
    assert "job" not in lines[-1], "what comes after the last job belongs to none"


def test_a_job_that_was_cancelled_while_it_waited_is_not_begun(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    write_row(connection, "job00001", cancel_requested_at=now())
    assert queue.enqueue(connection, "job00001", 1)

    def stopped() -> bool:
        return queue.status(connection, "job00001", 1).state == "stopped"

    with worker(redis_server, storage, tmp_path):
        wait_for(stopped)
    assert read_job(connection, "job00001").state == "queued", "the server says that it is cancelled"
    assert not (tmp_path / "diary").exists()


def test_an_entry_that_belongs_to_no_job_is_removed_and_the_next_one_runs(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    foreign = ["nonsense", "job-x", "-1"]
    for entry in foreign:
        entries.open_queue(connection).enqueue_call(entries.ATTEMPT, args=["?"], job_id=entry)
    connection.zadd(rq_keys.STARTED, {"nonsense:x": 1, "more nonsense": 1})
    write_row(connection, "job00001")
    assert queue.enqueue(connection, "job00001", 1)
    with worker(redis_server, storage, tmp_path):
        assert wait_for(partial(ended, redis_server, "job00001")).state == "succeeded"
    assert waiting(connection) == 0
    assert connection.zcard(rq_keys.STARTED) == 0
    assert not any(connection.exists(f"rq:job:{entry}") for entry in foreign)


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [3600.0, -3600.0])
def test_a_worker_whose_clock_is_off_runs_its_job_once(
    redis_server: RedisServer, storage: Storage, tmp_path: Path, ahead: float
) -> None:
    connection = redis_server.connection
    scripted(tmp_path, steps=16, pause=0.5)
    write_row(connection, "job00001")
    assert queue.enqueue(connection, "job00001", 1)
    with worker(redis_server, storage, tmp_path, clock_ahead=ahead):
        wait_for(lambda: connection.zcard(rq_keys.STARTED))
        first = connection.zrange(rq_keys.STARTED, 0, -1, withscores=True)
        wait_for(lambda: connection.zrange(rq_keys.STARTED, 0, -1, withscores=True) != first)
        # Prolonged by a heartbeat, by the clock of Redis.
        expires = cast(list[Any], connection.zrange(rq_keys.STARTED, 0, -1, withscores=True))[0][1]
        assert 0 < expires - connection.time()[0] <= leases.LEASE
        job = wait_for(partial(ended, redis_server, "job00001"))
    assert (job.state, job.attempt) == ("succeeded", 1)


KILLED = """
import os, signal, sys
from splatmill.backplane.queue import lines
from splatmill_worker.service import rq_worker
real = lines.take
def take_and_die(*arguments):
    taken = real(*arguments)
    if taken is not None and sys.argv[1] == "taken":
        os.kill(os.getpid(), signal.SIGKILL)
    return taken
lines.take = take_and_die
def fork_and_die(self, job, queue):
    os.kill(os.getpid(), signal.SIGKILL)
if sys.argv[1] == "before the fork":
    rq_worker.AttemptWorker.fork_work_horse = fork_and_die
from splatmill_worker.__main__ import main
sys.exit(main(["train"]))
"""


@pytest.mark.parametrize("moment", ["taken", "before the fork"])
def test_a_worker_killed_while_it_takes_a_job_loses_none(
    redis_server: RedisServer, storage: Storage, tmp_path: Path, moment: str
) -> None:
    connection = redis_server.connection
    for job_id in ("job00001", "job00002"):
        write_row(connection, job_id)
        assert queue.enqueue(connection, job_id, 1)
    environment = worker_environment(redis_server, storage, tmp_path)
    for _ in range(2):
        killed = subprocess.run([sys.executable, "-c", KILLED, moment], env=environment, timeout=60)
        assert killed.returncode == -signal.SIGKILL
    assert waiting(connection) + len(leases.held(connection)) == 2
    with worker(redis_server, storage, tmp_path):
        jobs = [wait_for(partial(ended, redis_server, job_id)) for job_id in ("job00001", "job00002")]
    assert [job.state for job in jobs] == ["succeeded", "succeeded"]
    assert (waiting(connection), leases.held(connection)) == (0, [])


def test_a_job_for_a_gpu_waits_for_a_worker_that_has_one(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    write_row(connection, "job00001", options=TrainOptions(backend=Backend.gpu))
    write_row(connection, "job00002")
    for job_id in ("job00001", "job00002"):
        assert queue.enqueue(connection, job_id, 1)
    with worker(redis_server, storage, tmp_path, "--queues", "any,cpu"):
        assert wait_for(partial(ended, redis_server, "job00002")).state == "succeeded"
        (listening,) = workers.listening(connection)
        assert listening.lines == ("any", "cpu")
    assert queue.status(connection, "job00001", 1).state == "waiting"
    environment = worker_environment(redis_server, storage, tmp_path)
    code = "import sys; from splatmill.backplane.connection import connect; "
    code += "from splatmill_worker.service.rq_worker import AttemptWorker; from tests.support.servers import standin; "
    code += "AttemptWorker(connect(sys.argv[1]), lambda: standin.run, ('gpu',)).work(burst=True)"
    subprocess.run([sys.executable, "-c", code, redis_server.url], env=environment, check=True, timeout=60)
    assert read_job(connection, "job00001").state == "succeeded"


def test_an_entry_whose_record_cannot_be_read_does_not_stop_the_worker(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    for job_id in ("job00001", "job00002"):
        write_row(connection, job_id)
        assert queue.enqueue(connection, job_id, 1)
    connection.hset("rq:job:job00001-1", "created_at", "?")
    with worker(redis_server, storage, tmp_path):
        assert wait_for(partial(ended, redis_server, "job00002")).state == "succeeded"
    # The reaper enqueues what the queue does not know.
    assert queue.status(connection, "job00001", 1).state == "absent"
    assert leases.held(connection) == []


@pytest.mark.parametrize("record", ["expired", "only taken off the list"])
def test_a_worker_whose_record_expired_while_redis_was_away_is_listed_again(
    record: str, redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    with worker(redis_server, storage, tmp_path):
        (before,) = wait_for(lambda: workers.listening(connection))
        expired = [before.key] if record == "expired" else []
        # At once: a heartbeat in between would write the record again, and its place in the list would be lost.
        connection.delete(*expired, "rq:workers", f"rq:workers:{entries.TRAIN}")
        (after,) = wait_for(lambda: workers.listening(connection))
        assert (after.name, after.lines) == (before.name, before.lines)


def test_an_attempt_that_ends_while_it_is_killed_takes_nothing_else_with_it(
    redis_server: RedisServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Group 0 is that of the caller: the worker and, where nothing gave it a group of its own, all around it."""
    killed: list[int] = []
    monkeypatch.setattr(os, "killpg", lambda group, _: killed.append(group))
    pids = iter([54321, 0])
    monkeypatch.setattr(AttemptWorker, "horse_pid", property(lambda _: next(pids)))
    AttemptWorker(redis_server.connection, lambda: standin.run, ("any",)).kill_horse()
    assert killed == [54321]

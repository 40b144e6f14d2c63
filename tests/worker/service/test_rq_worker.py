"""Proves that a worker runs its own attempt function for every entry, and for none of a cancelled job.

Does not prove what happens to attempts that are killed, stopped or cancelled while they run: tests/service does.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from rq.job import Callback

from splatmill.backplane import layout, queue
from splatmill.backplane.row import now
from splatmill.backplane.storage import Storage
from splatmill.schema import Job, Role
from tests.support.jobs import CAPTURE, read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.up import STANDIN
from tests.support.waiting import wait_for


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    """Storage with a capture that the stand-in trains in one step, and a diary of its attempts."""
    storage = Storage((tmp_path / "storage").as_uri())
    script = json.dumps({"steps": 1, "diary": str(tmp_path / "diary")}).encode()
    storage.put(layout.capture_file(CAPTURE, Role.images, "script.json"), script)
    return storage


@contextlib.contextmanager
def worker(server: RedisServer, storage: Storage, folder: Path) -> Iterator[None]:
    """A worker whose Python also finds the modules in `folder`."""
    environment = dict(os.environ) | {
        **STANDIN,
        "PYTHONPATH": f"{STANDIN['PYTHONPATH']}{os.pathsep}{folder}",
        "REDIS_URL": server.url,
        "SPLATMILL_STORAGE": storage.url,
        "SPLATMILL_DATA": str(folder / "data"),
    }
    process = subprocess.Popen([sys.executable, "-m", "splatmill_worker", "train"], env=environment)
    try:
        yield
    finally:
        process.terminate()
        process.wait(30)


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
        "job00001": queue.ATTEMPT,
        "job00002": "splatmill_worker.job.run_attempt",  # the name in entries of earlier versions
        "job00003": "splatmill_worker.service.job.run_attempt",
        "job00004": "intruder.called",
        "job00005": "there.is.no.such.function",
    }
    for job_id, function in functions.items():
        write_row(redis_server.connection, job_id)
        queue.open_queue(redis_server.connection).enqueue_call(
            function,
            args=[job_id],
            job_id=queue.rq_id(job_id, 1),
            timeout=queue.JOB_TIMEOUT,
            on_success=Callback("intruder.called"),
            on_failure=Callback("intruder.called"),
        )
    with worker(redis_server, storage, tmp_path):
        jobs = {job_id: wait_for(partial(ended, redis_server, job_id)) for job_id in functions}
    assert {job_id: job.state for job_id, job in jobs.items()} == dict.fromkeys(functions, "succeeded")
    assert {job.attempt for job in jobs.values()} == {1}
    assert not trace.exists()


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

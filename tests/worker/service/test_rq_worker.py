"""Proves that nothing an entry of the queue names is imported: a worker runs its own attempt function, and only that.

Does not prove what happens to attempts that are killed, stopped or cancelled: tests/service does.
"""

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, cast

from rq.job import Callback

from splatmill.backplane import events, keys, layout, queue
from splatmill.backplane.fold import fold
from splatmill.backplane.row import JobRow, now, read
from splatmill.backplane.storage import Storage
from splatmill.schema import Job, Role, TrainOptions
from tests.support.redis_server import RedisServer
from tests.support.up import STANDIN
from tests.support.waiting import wait_for

CAPTURE = "capture1"


def submit(server: RedisServer, job_id: str, function: str) -> None:
    """A job whose entry names `function`, and which asks for callbacks of the same module."""
    row = JobRow(id=job_id, capture=CAPTURE, options=TrainOptions(), created_at=now(), queued_at=now())
    server.connection.hset(keys.job(job_id), mapping=cast(dict[Any, Any], row.fields()))
    queue.open_queue(server.connection).enqueue_call(
        function,
        args=[job_id],
        job_id=queue.rq_id(job_id, 1),
        timeout=queue.JOB_TIMEOUT,
        on_success=Callback("intruder.called"),
        on_failure=Callback("intruder.called"),
    )


def final(server: RedisServer, job_id: str) -> Job | None:
    """The job once it has ended."""
    row = read(server.connection, job_id)
    assert row is not None
    job = fold(row, events.read_states(server.connection, job_id))
    return job if job.state.final else None


def test_the_function_that_an_entry_names_is_never_imported(
    redis_server: RedisServer, tmp_path: Path
) -> None:
    storage = Storage((tmp_path / "storage").as_uri())
    script = json.dumps({"steps": 1, "diary": str(tmp_path / "diary")}).encode()
    storage.put(layout.capture_file(CAPTURE, Role.images, "script.json"), script)
    trace = tmp_path / "intruder was here"
    (tmp_path / "intruder.py").write_text(
        f"from pathlib import Path\nPath({str(trace)!r}).touch()\ndef called(*args): Path({str(trace)!r}).touch()\n"
    )
    jobs = {
        "job00001": queue.ATTEMPT,
        "job00002": "splatmill_worker.job.run_attempt",  # what servers of earlier versions put there
        "job00003": "splatmill_worker.service.job.run_attempt",
        "job00004": "intruder.called",
        "job00005": "there.is.no.such.function",
    }
    for job_id, function in jobs.items():
        submit(redis_server, job_id, function)
    environment = dict(os.environ) | {
        **STANDIN,
        "PYTHONPATH": f"{STANDIN['PYTHONPATH']}{os.pathsep}{tmp_path}",
        "REDIS_URL": redis_server.url,
        "SPLATMILL_STORAGE": storage.url,
        "SPLATMILL_DATA": str(tmp_path / "data"),
    }
    worker = subprocess.Popen([sys.executable, "-m", "splatmill_worker", "train"], env=environment)
    try:
        ended = {job_id: wait_for(partial(final, redis_server, job_id)) for job_id in jobs}
    finally:
        worker.terminate()
        worker.wait(30)
    assert {job_id: found.state for job_id, found in ended.items()} == dict.fromkeys(jobs, "succeeded")
    assert {found.attempt for found in ended.values()} == {1}
    assert not trace.exists()

"""Cancelling real processes, and what the reaper mends: lost attempts, used-up tries, jobs the queue forgot.

The worker is RQ's own but for the queue, in a process of its own, with an attempt that sleeps. Not proved here: the
project's worker (tests/service), whose attempts also resume.
"""

import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatmill.backplane import keys
from splatmill.backplane.jobs import row
from splatmill.backplane.queue import entries, leases, queue, rq_keys
from splatmill.schema import JobState, ProgressEvent, StateEvent
from tests.support.served_app import Serve, ServedApp, store_model
from tests.support.servers.queue_entries import take, waiting
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

WORKER = textwrap.dedent(
    """
    import os, pathlib, sys, time
    from rq import Worker
    from rq.executions import Execution
    from splatmill.backplane.queue import entries, lines
    from splatmill.backplane.connection import connect
    class Entry(entries.QueueEntry):
        def func(self, job_id):
            pathlib.Path(sys.argv[2]).write_text(str(os.getpid()))
            if sys.argv[3] == "die":
                os._exit(1)
            while sys.argv[3] == "sleep":
                time.sleep(0.05)
    class Quick(Worker):
        def get_heartbeat_ttl(self, job):
            return 2
        def dequeue_job_and_maintain_ttl(self, timeout, max_idle_time=None):
            while True:
                self.heartbeat()
                taken = lines.take(self.connection, self.name, lines.LINES)
                if taken is not None:
                    lease, _ = taken
                    self.execution = Execution(lease.execution, lease.entry, self.connection, self.name)
                    return Entry.fetch(lease.entry, self.connection, entries.SERIALIZER), self.queues[0]
                if timeout is None:
                    return None
                lines.wait(self.connection, lines.LINES, 1)
        def prepare_execution(self, job):
            self.set_state("busy")
    lines.LEASE = 2
    connection = connect(sys.argv[1])
    worker = Quick(
        [entries.open_queue(connection)], connection=connection, job_class=Entry, serializer=entries.SERIALIZER
    )
    worker.work(burst=sys.argv[3] != "sleep", logging_level="ERROR")
    """
)


@pytest.fixture
def quick_leases(app: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Redis that has been there for longer than a lease."""
    monkeypatch.setattr(leases, "LEASE", 2)
    wait_for(lambda: app.redis.info("server")["uptime_in_seconds"] >= 2)


@contextmanager
def worker(app: ServedApp, pid_file: Path, what: str = "sleep") -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-c", WORKER, app.settings.redis_url, str(pid_file), what]
    # RQ's own worker, asked to end an attempt that has just ended, kills its own group: it has one to itself.
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        if pid_file.exists():
            pid = int(pid_file.read_text())
            if alive(pid):
                os.kill(pid, 9)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_waiting_job_is_cancelled_at_once(app: ServedApp) -> None:
    job_id = app.job()
    answer = app.http.post(f"/v1/jobs/{job_id}/cancel")
    assert (answer.status_code, answer.json()["state"]) == (202, "cancelled")
    assert answer.json()["finished_at"]
    assert waiting(app.redis) == 0
    assert app.http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"


def test_cancelled_is_said_only_once_the_process_is_dead(serve: Serve, tmp_path: Path) -> None:
    app = serve()
    job_id = app.job()
    pid_file = tmp_path / "pid"
    with worker(app, pid_file):
        pid = int(wait_for(lambda: pid_file.exists() and pid_file.read_text(), 20))
        begun = time.monotonic()
        first = app.http.post(f"/v1/jobs/{job_id}/cancel").json()
        assert first["cancel_requested"]
        wait_for(lambda: app.state(job_id) == "cancelled" or (alive(pid) and False))
        assert not alive(pid)
        assert time.monotonic() - begun < 2
    # A wish that came too late for the worker's last word is no cancel.
    done = app.job()
    app.begin(done)
    app.finish(done)
    assert app.http.post(f"/v1/jobs/{done}/cancel").status_code == 409


def test_a_final_state_that_comes_after_the_verdict_is_too_late(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    assert app.state(job_id) == "cancelled"
    app.say(job_id, StateEvent(state=JobState.succeeded))
    assert app.state(job_id) == "cancelled"
    app.http.post(f"/v1/jobs/{job_id}/restart")
    assert app.state(job_id) == "queued"


def test_a_dead_workers_attempt_is_queued_again(app: ServedApp, tmp_path: Path, quick_leases: None) -> None:
    job_id = app.job()
    pid_file = tmp_path / "pid"
    with worker(app, pid_file) as process:
        pid = int(wait_for(lambda: pid_file.exists() and pid_file.read_text(), 20))
        assert queue.status(app.redis, job_id, 1).state == "running"
        process.kill()
        process.wait()
        os.kill(pid, 9)
    # Its heartbeat was good for two seconds; the reaper sees that it is over.
    wait_for(lambda: app.service.reaper.tick() or queue.status(app.redis, job_id, 1).state == "waiting")
    assert app.state(job_id) == "queued"


def test_a_job_whose_tries_are_used_up_fails_by_name(app: ServedApp, tmp_path: Path) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.training), ProgressEvent(stage="training", done=3))
    with worker(app, tmp_path / "pid", "die") as process:
        process.wait(60)
    assert queue.status(app.redis, job_id, 1).state == "failed"
    app.service.reaper.tick()
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert job["state"] == "failed"
    assert job["problem"]["code"] == "attempts_exhausted"
    assert job["problem"]["facts"]["stage"] == "training"
    assert "restart" in job["problem"]["advice"]
    assert app.http.post(f"/v1/jobs/{job_id}/restart").json()["state"] == "queued"


def test_an_attempt_that_ends_without_a_word_is_noticed_on_the_second_look(
    app: ServedApp, tmp_path: Path
) -> None:
    job_id = app.job()
    with worker(app, tmp_path / "pid", "return") as process:
        process.wait(60)
    app.service.reaper.tick()
    assert app.state(job_id) == "queued"  # its last word may still be on its way
    app.service.reaper.tick()
    assert app.http.get(f"/v1/jobs/{job_id}").json()["problem"]["code"] == "worker_lost"


@pytest.mark.parametrize("cancelled", [False, True])
def test_a_job_whose_model_is_stored_has_succeeded_though_no_attempt_said_so(
    app: ServedApp, tmp_path: Path, cancelled: bool
) -> None:
    job_id = app.job()
    with worker(app, tmp_path / "pid", "return") as process:
        process.wait(60)
    store_model(app.service, job_id)
    if cancelled:
        app.http.post(f"/v1/jobs/{job_id}/cancel")
    for _ in range(2):
        app.service.reaper.tick()
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["model"]) == ("succeeded", job_id)
    assert [model["id"] for model in app.http.get("/v1/models").json()["models"]] == [job_id]


def test_a_job_the_queue_forgot_is_queued_again_once(app: ServedApp) -> None:
    job_id = app.job()
    queue.forget(app.redis, job_id, 1)
    assert queue.status(app.redis, job_id, 1).state == "absent"
    for _ in range(3):
        app.service.reaper.tick()
    assert waiting(app.redis) == 1
    # A cancelled one is not: the wish is fulfilled by its absence.
    other = app.job()
    queue.forget(app.redis, other, 1)
    app.service.jobs.cancel(other)
    app.service.reaper.tick()
    assert app.state(other) == "cancelled"


def test_what_seems_to_run_and_is_held_by_nobody_is_queued_again(app: ServedApp) -> None:
    """What RQ records of an attempt that began in an emptied Redis, and whose worker was killed."""
    job_id = app.job()
    lease = take(app.redis)

    def look() -> list[queue.QueueState]:
        app.service.reaper.tick()
        return queue.states(app.redis, [(job_id, 1)])

    app.redis.delete(f"rq:job:{lease.entry}")
    app.redis.hset(f"rq:job:{lease.entry}", mapping={"status": "started", "worker_name": "killed"})
    assert [look() for _ in range(3)] == [["running"]] * 3, "the lease has not expired"
    app.redis.zrem(rq_keys.STARTED, lease.member)
    app.redis.sadd(keys.RESTORED, job_id)
    app.redis.expire(keys.RESTORED, 15)
    assert look() == ["running"], "a worker may take the lease again"
    app.redis.delete(keys.RESTORED)
    assert look() == ["waiting"]
    assert waiting(app.redis) == 1


def test_a_wish_that_outlived_the_server_is_fulfilled_by_the_next_one(serve: Serve) -> None:
    app = serve()
    job_id = app.job()
    app.service.jobs.cancel(job_id)  # the wish is noted, and the server dies before it does anything about it
    assert app.state(job_id) == "queued"
    serve(reaper_interval=0.05)
    wait_for(lambda: app.state(job_id) == "cancelled")


def test_two_reapers_at_once_requeue_an_attempt_once(app: ServedApp, quick_leases: None) -> None:
    app.job()
    lease = take(app.redis)
    app.redis.zadd(rq_keys.STARTED, {lease.member: 1})
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: leases.Reclaim(app.redis).run(), range(8)))
    assert [became for runs in results for _, became in runs] == ["waiting"]
    assert waiting(app.redis) == 1


def test_a_job_whose_worker_is_lost_again_and_again_fails_by_name(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.sfm), ProgressEvent(stage="features", done=3))
    for _ in range(leases.MAX_LOST):
        leases.requeue(app.redis, take(app.redis), if_expired=False)
    app.service.reaper.tick()
    problem = app.http.get(f"/v1/jobs/{job_id}").json()["problem"]
    assert problem["code"] == "attempts_exhausted"
    assert f"lost {leases.MAX_LOST} times in a row during features" in problem["detail"]
    assert problem["facts"]["lost_workers"] == leases.MAX_LOST
    # A restart is a new generation, which may lose as many.
    assert app.http.post(f"/v1/jobs/{job_id}/restart").json()["state"] == "queued"
    assert leases.lost(app.redis, entries.rq_id(job_id, 2)) == 0


def test_the_reaper_looks_at_unfinished_jobs_alone_and_at_all_of_them(app: ServedApp) -> None:
    capture_id = app.capture()
    waiting, ended = app.job(capture_id), app.job(capture_id)
    app.begin(ended)
    app.finish(ended)
    app.service.reaper.tick()
    assert app.redis.smembers(keys.ACTIVE) == {waiting.encode()}
    app.http.post(f"/v1/jobs/{ended}/restart")
    app.service.reaper.tick()
    assert app.redis.smembers(keys.ACTIVE) == {waiting.encode(), ended.encode()}
    for job_id in (waiting, ended):
        app.http.post(f"/v1/jobs/{job_id}/cancel")
        app.http.delete(f"/v1/jobs/{job_id}")
    assert app.redis.smembers(keys.ACTIVE) == set()


@pytest.mark.parametrize(
    ("change", "verdict", "state"),
    [
        ("restart", "cancelled", "queued"),
        ("final", "cancelled", "succeeded"),
        ("cancel", "failed", "preparing"),
    ],
)
def test_a_verdict_on_what_changed_meanwhile_is_not_given(
    app: ServedApp, change: str, verdict: str, state: str
) -> None:
    job_id = app.job()
    app.begin(job_id)
    old = row.read(app.redis, job_id)
    assert old is not None
    if change == "cancel":
        app.service.jobs.cancel(job_id)
    else:
        app.say(job_id, StateEvent(state=JobState.succeeded))
    if change == "restart":
        app.http.post(f"/v1/jobs/{job_id}/restart")
    assert app.service.jobs.give_verdict(old, verdict) is False
    assert app.state(job_id) == state

"""Proves that a signal to stop ends the worker wherever it arrives, and loses no entry of the queue.

Each program below delivers the signal at one exact point. Does not prove how attempts are stopped: tests/service does.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from splatmill.backplane.queue import leases, queue
from splatmill.backplane.storage.storage import Storage
from tests.support.jobs import read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.servers.queue_entries import waiting
from tests.support.up import worker_environment

CONTINUES = 3
"""Exit status of a worker that waits for work after it was told to stop."""

RAISES = 4
"""Exit status of a worker whose signal handler raises an exception."""

START = f"""
import io, os, signal, sys, threading
import rq.worker.base
from splatmill.backplane.queue import leases, lines, workers
from splatmill_worker.__main__ import main
from splatmill_worker.service import rq_worker

rq_worker._IDLE_SECONDS = 3600.0
sent = False
real_wait = lines.wait
def before_wait():
    pass
def wait(*arguments):
    if sent:
        os._exit({CONTINUES})
    before_wait()
    real_wait(*arguments)
lines.wait = wait
"""

INTERRUPTED = f"""
module, name = {{
    "suspension": (rq.worker.base, "is_suspended"),
    "heartbeat": (workers, "spare"),
    "take": (lines, "take"),
    "unreadable entry": (leases, "drop"),
    "wait": (sys.modules["__main__"], "before_wait"),
}}[sys.argv[1]]
real = getattr(module, name)
def interrupted(*arguments):
    global sent
    if not sent and callable(signal.getsignal(signal.SIGTERM)):
        sent = True
        try:
            signal.raise_signal(signal.SIGTERM)
        except BaseException:
            os._exit({RAISES})
    return real(*arguments)
setattr(module, name, interrupted)
sys.exit(main(["train"]))
"""

TAKEN = """
def deliver():
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # whatever the worker blocks in its own thread
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
real_take = lines.take
def take(*arguments):
    global sent
    taken = real_take(*arguments)
    if taken is not None:
        sent = True
        thread = threading.Thread(target=deliver)
        thread.start()
        thread.join()
    return taken
lines.take = take
sys.exit(main(["train"]))
"""

LOGGED = """
class Stderr(io.RawIOBase):
    def writable(self):
        return True
    def write(self, data):
        global sent
        if not sent and b"has ended" in bytes(data):
            sent = True
            signal.raise_signal(signal.SIGTERM)
        return os.write(2, data)
sys.stderr = io.TextIOWrapper(io.BufferedWriter(Stderr()), line_buffering=True)
sys.exit(main(["train"]))
"""


def run(program: str, server: RedisServer, storage: Storage, folder: Path, *arguments: str) -> int:
    """Run a worker to its end and return its exit status."""
    environment = worker_environment(server, storage, folder, SPLATMILL_LOG_FORMAT="json")
    command = [sys.executable, "-c", START + program, *arguments]
    return subprocess.run(command, env=environment, timeout=60).returncode


@pytest.mark.parametrize("point", ["suspension", "heartbeat", "take", "unreadable entry", "wait"])
def test_a_signal_to_stop_ends_the_worker_and_raises_nothing(
    redis_server: RedisServer, storage: Storage, tmp_path: Path, point: str
) -> None:
    """redis-py drops exceptions in its metrics, and hiredis crashes on one. A wait for work ends at once."""
    connection = redis_server.connection
    if point == "unreadable entry":
        write_row(connection, "job00001")
        assert queue.enqueue(connection, "job00001", 1)
        connection.hset("rq:job:job00001-1", "created_at", "?")
    assert run(INTERRUPTED, redis_server, storage, tmp_path, point) == 0
    assert connection.smembers("rq:workers") == set()


def test_an_entry_waits_again_if_another_thread_receives_the_signal_while_it_is_taken(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    connection = redis_server.connection
    write_row(connection, "job00001")
    assert queue.enqueue(connection, "job00001", 1)
    assert run(TAKEN, redis_server, storage, tmp_path) == 0
    assert (waiting(connection), leases.held(connection)) == (1, [])


def test_a_worker_ends_where_the_signal_interrupts_a_write_to_its_log(
    redis_server: RedisServer, storage: Storage, tmp_path: Path
) -> None:
    """Python refuses to write to a stream inside a write to it."""
    connection = redis_server.connection
    write_row(connection, "job00001")
    assert queue.enqueue(connection, "job00001", 1)
    assert run(LOGGED, redis_server, storage, tmp_path) == 0
    assert read_job(connection, "job00001").state == "succeeded"

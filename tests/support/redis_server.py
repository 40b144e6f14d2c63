"""A real Redis of a test's own. A conftest.py that imports `redis_server` or `connection` offers them as fixtures."""

import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import redis

from splatmill.backplane.connection import connect
from splatmill.backplane.redis_program import find
from tests.support.waiting import wait_for


class RedisServer:
    """A Redis without the service. It can be killed, and has all its data again when it is started anew."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "r.sock"
        self.url = f"unix://{self.path}"
        self.connection = connect(self.url, retries=0)
        self._command = [str(find().path), "--port", "0", "--unixsocket", str(self.path)]
        # The default, everysec, holds back writes that were answered while the disk is slow; a kill then loses them.
        self._command += ["--appendonly", "yes", "--appendfsync", "no", "--save", "", "--dir", str(folder)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)
        wait_for(self._answers)

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait(60)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Keep it from answering. Its connections stay."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def _answers(self) -> bool:
        try:
            return bool(self.connection.ping())
        except redis.ConnectionError:
            return False


@contextmanager
def empty_redis(folder: Path) -> Iterator[str]:
    """Run a Redis in `folder`, whose contents are deleted before, and yield its URL.

    The path must be short: that of a unix socket has 107 bytes at most.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    server = RedisServer(folder)
    server.start()
    try:
        yield server.url
    finally:
        server.connection.close()
        server.kill()


@pytest.fixture
def redis_server(tmp_path: Path) -> Iterator[RedisServer]:
    """A running Redis that the test may kill."""
    server = RedisServer(tmp_path)
    server.start()
    yield server
    server.connection.close()
    server.kill()


@pytest.fixture
def connection(redis_server: RedisServer) -> redis.Redis:
    """A connection to an empty Redis."""
    return redis_server.connection

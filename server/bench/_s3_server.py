"""moto's S3 server for the time of a benchmark: a real server of the protocol, slower than a bucket's."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx

_START_SECONDS = 60.0


def command(port: int) -> list[str]:
    """Return the command that serves S3 on a port of this machine."""
    return [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]


def environment(port: int) -> dict[str, str]:
    """Return the environment variables with which a process finds the server behind a port."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "bench",
        "AWS_SECRET_ACCESS_KEY": "bench",
        "AWS_REGION": "us-east-1",
    }


@contextmanager
def running(bucket: str) -> Iterator[str]:
    """Run a server with an empty bucket that this process and its children find, and yield a URL of storage in it.

    Raises RuntimeError if it does not answer.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    process = subprocess.Popen(command(port), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    before = {name: os.environ.get(name) for name in environment(port)}
    os.environ.update(environment(port))
    try:
        _create(f"http://127.0.0.1:{port}/{bucket}")
        yield f"s3://{bucket}/data"
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
        process.terminate()
        process.wait(30)


def _create(url: str) -> None:
    end = time.monotonic() + _START_SECONDS
    while True:
        try:
            httpx.put(url, trust_env=False, timeout=60).raise_for_status()
            return
        except httpx.HTTPError as error:
            if time.monotonic() > end:
                raise RuntimeError(
                    f"The S3 server does not answer for {_START_SECONDS:.0f} s: {error}."
                ) from error
            time.sleep(0.1)

"""An S3 bucket of the test's own: moto's server, which speaks the S3 API over HTTP and keeps the objects in memory."""

import contextlib
from collections.abc import Iterator

import httpx
import pytest


@contextlib.contextmanager
def bucket() -> Iterator[str]:
    """Serve an empty bucket and return its address for `Storage`, with the AWS_* variables set; skip without moto."""
    server_module = pytest.importorskip("moto.server", reason="moto plays S3: pip install 'moto[server]'")
    server = server_module.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        host, port = server.get_host_and_port()
        url = f"http://{host}:{port}"
        patch.setenv("AWS_ENDPOINT_URL", url)
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_REGION", "us-east-1")
        assert httpx.put(f"{url}/captures-test", trust_env=False, timeout=60).status_code == 200
        try:
            yield "s3://captures-test/data"
        finally:
            server.stop()

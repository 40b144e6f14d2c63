"""Fixtures of the server's tests: a real Redis on a unix socket, and the real app in a real uvicorn."""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import redis
import structlog
from structlog.testing import CapturingLogger

from splatmill.backplane.connection import connect
from splatmill_server.base.settings import Settings
from tests.support.redis_server import empty_redis
from tests.support.redis_server import redis_server as redis_server
from tests.support.served_app import Serve, ServedApp, served_app
from tests.support.servers.rendering import folder as folder
from tests.support.servers.rendering import renderer as renderer
from tests.support.servers.scripted_server import peer as peer


@pytest.fixture(scope="session", autouse=True)
def plain_log() -> None:
    """structlog's own default prints every local variable of a traceback, which takes it many seconds."""
    structlog.configure(
        processors=[structlog.processors.format_exc_info, structlog.processors.JSONRenderer()],
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING),
    )


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A Redis of our own for all tests."""
    folder = tmp_path_factory.mktemp("redis")
    with empty_redis(folder) as url:
        yield url


@pytest.fixture
def connection(redis_url: str) -> Iterator[redis.Redis]:
    """An empty Redis."""
    client = connect(redis_url)
    client.flushall()
    yield client
    client.close()


@pytest.fixture
def serve(redis_url: str, connection: redis.Redis, tmp_path: Path) -> Iterator[Serve]:
    """Start an app with these settings; it is stopped after the test."""
    with contextlib.ExitStack() as stack:

        def start(**settings: Any) -> ServedApp:
            # The reaper ticks when a test asks it to, unless the test is about its clock.
            defaults: dict[str, Any] = {
                "redis_url": redis_url,
                "data": tmp_path / "data",
                "reaper_interval": 3600,
            }
            return stack.enter_context(served_app(Settings(**(defaults | settings)), connection))

        yield start


@pytest.fixture
def app(serve: Serve) -> ServedApp:
    """The app with its default settings."""
    return serve()


@pytest.fixture
def lines() -> Iterator[CapturingLogger]:
    """Everything that is logged, as dictionaries."""
    before = structlog.get_config()
    captured = CapturingLogger()
    structlog.configure(
        processors=[structlog.stdlib.add_log_level, lambda _, __, fields: ((), fields)],
        wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG),
        logger_factory=lambda *_: captured,
        cache_logger_on_first_use=False,
    )
    yield captured
    structlog.configure(**before)

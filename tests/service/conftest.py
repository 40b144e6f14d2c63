"""What the service's tests run against: a real `splatmill up` (tests/support/up.py), for all of them or for one.

Only the pipeline is a stand-in (tests/support/servers/standin.py), so that a test can stop, crash or slow it at a
chosen step.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.redis_server import redis_server as redis_server
from tests.support.up import Up


@pytest.fixture(scope="session")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    up = Up(tmp_path_factory.mktemp("up") / "data")
    yield up
    up.close()


@pytest.fixture
def service(shared_service: Up) -> Up:
    """One running service for all tests that leave it running, also after they have stopped it."""
    if shared_service.process is None:
        shared_service.start()
    return shared_service


@pytest.fixture
def own_service(tmp_path: Path) -> Iterator[Up]:
    """A service of the test's own, not yet started."""
    up = Up(tmp_path / "data")
    yield up
    up.close()

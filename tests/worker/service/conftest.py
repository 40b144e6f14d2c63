"""What the queue worker's tests share: a Redis of the test's own, and storage that holds one capture.

Remote storage is played by a local folder that does not say where its files lie: each copy then really happens.
"""

from pathlib import Path

import pytest
import redis

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Role
from splatmill_worker.service.room import Room
from tests.support.files.other_file_system import other_file_system as other_file_system
from tests.support.jobs import CAPTURE
from tests.support.redis_server import connection as connection
from tests.support.redis_server import redis_server as redis_server
from tests.support.up import scripted


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    """Storage with a capture that the stand-in trains in three steps, and a diary of its attempts."""
    return scripted(tmp_path, steps=3)


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Storage:
    """Storage in a folder of this machine, with two photos and a mask in CAPTURE."""
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "data"))
    return with_capture(tmp_path / "storage")


@pytest.fixture
def elsewhere(other_file_system: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Storage:
    """The same storage on another file system than the work folder."""
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "data"))
    return with_capture(other_file_system / "storage")


def with_capture(folder: Path) -> Storage:
    storage = Storage(folder.as_uri())
    for name in ("a.jpg", "deep/b.jpg"):
        storage.put(layout.capture_file(CAPTURE, Role.images, name), name.encode())
    storage.put(layout.capture_file(CAPTURE, Role.masks, "a.png"), b"mask")
    return storage


@pytest.fixture
def remote(local: Storage) -> Storage:
    """The same storage, as if it were an S3 bucket."""
    local.root = None
    return local


@pytest.fixture
def room(connection: redis.Redis) -> Room:
    """The room of the job "job00001", whose owner has no limit."""
    return Room(connection, "default", "job00001")

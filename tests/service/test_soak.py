"""A short soak: a fault of each main kind against the whole service, which then must have lost nothing.

`make soak` runs hundreds. What is judged at the end is proven here to find what it looks for. Not proven: faults of S3,
the engine's own jobs, and that hundreds are survived.
"""

import hashlib
import json
from pathlib import Path

import pytest
import soak
from _soak import verdict
from _soak.clients import Promise

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage
from splatmill.schema import Role

KINDS = (
    "trainer killed",
    "worker killed",
    "API killed",
    "everything killed",
    "Redis cut off",
    "disk full",
    "clock set",
)


@pytest.mark.slow
def test_a_fault_of_each_kind_loses_nothing() -> None:
    *faults, end = soak.soak(s3=False, count=0, seed=1, only=KINDS)
    assert {row["fault"] for row in faults} | end["left_out"].keys() >= set(KINDS)
    assert end["complaints"] == []
    assert end["succeeded"] >= 3


@pytest.fixture
def stored(tmp_path: Path) -> tuple[Storage, Promise]:
    """A job that has succeeded, with its capture and model in storage."""
    storage = Storage(str(tmp_path))
    promise = Promise("job00001", "capture1", {"images/a.jpg": b"photo"}, state="succeeded")
    storage.put(layout.capture_file("capture1", Role.images, "a.jpg"), b"photo")
    storage.put(layout.model_file("job00001", "model.ply"), b"model")
    record = {"sha256": {"model.ply": hashlib.sha256(b"model").hexdigest()}}
    storage.put(layout.job_record("job00001"), json.dumps(record).encode())
    return storage, promise


def test_whole_files_are_no_complaint(stored: tuple[Storage, Promise]) -> None:
    storage, promise = stored
    assert verdict.halves([promise], storage) == []


@pytest.mark.parametrize(
    ("path", "content"),
    [
        (layout.capture_file("capture1", Role.images, "a.jpg"), b"pho"),
        (layout.model_file("job00001", "model.ply"), b"mod"),
        (layout.job_record("job00001"), b"{"),
    ],
)
def test_half_a_file_is_found(stored: tuple[Storage, Promise], path: str, content: bytes) -> None:
    storage, promise = stored
    storage.put(path, content)
    (found,) = verdict.halves([promise], storage)
    assert "job00001" in found or path in found


@pytest.mark.parametrize("path", ["captures/capture1/files/images/a.jpg", "models/job00001/model.ply"])
def test_a_missing_file_is_found(stored: tuple[Storage, Promise], path: str) -> None:
    storage, promise = stored
    storage.delete(path)
    assert len(verdict.halves([promise], storage)) == 1


def test_attempts_beside_each_other_are_found() -> None:
    begin = {"what": "begin", "job": "a", "pid": 7}
    assert verdict.twice([begin | {"overlap": False}, {"what": "step", "job": "a", "pid": 7}]) == []
    assert verdict.twice([begin | {"overlap": True}]) == [
        "two attempts at a ran at once, one of them process 7"
    ]

"""Proves which checkpoints count as progress of an attempt: those that it stored, not one that it downloaded."""

import os
from pathlib import Path

import pytest

from splatmill_worker.service.saved_progress import SavedProgress
from splatmill_worker.settings import work_folder


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run folder of a job, which does not exist yet."""
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path))
    return work_folder("job00001") / "run"


def store(run: Path, moment: int, name: str = "checkpoint.pt") -> None:
    """Store a checkpoint at this time in seconds."""
    path = run / "checkpoints" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"state")
    os.utime(path, (moment, moment))


def test_each_new_checkpoint_counts_once(run: Path) -> None:
    run.mkdir(parents=True)
    saved = SavedProgress("job00001")
    assert not saved.advanced()
    store(run, 1)
    assert saved.advanced()
    assert not saved.advanced()
    store(run, 2)
    assert saved.advanced()


def test_a_checkpoint_of_an_earlier_attempt_does_not_count(run: Path) -> None:
    store(run, 1)
    saved = SavedProgress("job00001")
    assert not saved.advanced()
    store(run, 2)
    assert saved.advanced()


def test_a_checkpoint_that_may_be_a_download_does_not_count(run: Path) -> None:
    saved = SavedProgress("job00001")
    store(run, 1)
    assert not saved.advanced()
    store(run, 2)
    assert saved.advanced()


def test_a_file_that_is_being_written_does_not_count(run: Path) -> None:
    run.mkdir(parents=True)
    saved = SavedProgress("job00001")
    store(run, 1, ".checkpoint.pt.part")
    assert not saved.advanced()

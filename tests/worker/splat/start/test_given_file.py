"""Proves that a model to start from is read outside of the attempt, reduced there, and refused if it fills the memory.

Does not prove what confines the process that reads it: `tests/worker/test_sandbox.py` does.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from splatmill_worker.errors import StartUnusable, WorkerError
from splatmill_worker.images.decoding import decoders
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.given_model import read_given_model
from tests.support.decoding.acting import children
from tests.support.gaussians import some_gaussians
from tests.support.hostile import model_bombs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc"),
]


def read_model(path: Path, most: int = 10**6) -> tuple[Gaussians, int]:
    start = read_given_model(path, Normalization(1.0, np.zeros(3)), most)
    return start.gaussians, start.count


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    with decoders.confined([tmp_path]):
        yield tmp_path


def forbidden(path: Path) -> None:
    raise AssertionError(f"{path} was read in the attempt itself")


def test_the_attempt_itself_reads_no_byte_of_a_model(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry.write(folder / "m.ply", some_gaussians(300, 2))
    expected = registry.read(folder / "m.ply").gaussians
    waiting = children()
    monkeypatch.setattr(registry, "read", forbidden)
    gaussians, count = read_model(folder / "m.ply")
    assert count == 300
    for value, same in zip(gaussians, expected, strict=True):
        assert torch.equal(value, same)
    assert children() == waiting  # the process of the model has ended


def test_a_larger_model_is_reduced_before_it_reaches_the_attempt(folder: Path) -> None:
    registry.write(folder / "m.ply", some_gaussians(300, 1))
    expected = registry.read(folder / "m.ply").gaussians
    gaussians, count = read_model(folder / "m.ply", most=20)
    assert (gaussians.count, count) == (20, 300)
    kept = expected.logit_opacities.sort(descending=True).values[:20]
    assert torch.equal(gaussians.logit_opacities.sort(descending=True).values, kept)


@pytest.mark.parametrize(
    "what",
    [
        "a .sog of which one PNG of 250 megapixels serves every plane",
        "a .sog of 1 kB that announces 4 million Gaussians, and has their pixels",
    ],
)
def test_what_would_fill_the_memory_is_refused(folder: Path, what: str) -> None:
    suffix, made = model_bombs.MODELS[what]
    (folder / f"m{suffix}").write_bytes(made())
    Path("/proc/self/clear_refs").write_text("5")
    before = status("VmRSS")
    with pytest.raises(StartUnusable, match=rf"m\{suffix} could not be read as a SOG model"):
        read_model(folder / f"m{suffix}")
    assert status("VmHWM") - before < 50 * 10**6


def test_a_model_whose_processes_are_killed_is_not_called_unusable(folder: Path) -> None:
    registry.write(folder / "m.ply", some_gaussians(300, 2))
    done = threading.Event()

    def kill() -> None:
        while not done.is_set():
            with suppress(OSError):  # one that has ended meanwhile
                for pid in children():
                    os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        with pytest.raises(WorkerError) as error:
            read_model(folder / "m.ply")
    finally:
        done.set()
        killer.join()
    assert error.value.code == "decoder_ended"  # which the service tries again
    assert read_model(folder / "m.ply")[1] == 300


def status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    raise KeyError(name)

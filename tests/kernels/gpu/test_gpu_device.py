"""Messages and choices where there is no usable GPU, and that importing the package touches neither Triton nor a GPU.

A card that is too old is played by replacing what torch answers; the memory budget is arithmetic, not a measurement.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.gpu import device

NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")


@NO_GPU
def test_an_absent_gpu_is_none_and_a_sentence() -> None:
    assert device.describe() is None
    reason = device.absence()
    assert reason is not None
    assert reason.endswith(".")


def test_a_card_that_is_too_old_is_named_with_what_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (6, 1))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "GeForce GTX 1080")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: object())
    reason = device.absence()
    assert reason is not None
    assert "GeForce GTX 1080" in reason
    assert "6.1" in reason
    assert "8.0" in reason
    assert device.absence(3) == "GPU 3 was asked for and there are 1."
    assert device.describe() is None


def test_a_machine_without_triton_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    reason = device.absence()
    assert reason is not None
    assert "pip install" in reason


def test_tensors_on_the_cpu_are_refused_unless_the_interpreter_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    with pytest.raises(device.GpuUnavailable, match='use "cpu"'):
        device.require(torch.zeros(1))
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    device.require(torch.zeros(1))


def test_the_budget_is_the_largest_that_fits() -> None:
    free, pixels, photos = 24 * 2**30, 1920 * 1080, 300 * 3 * 1920 * 1080
    most = device.largest_budget(free, pixels, photos)
    room = (0.85 - device.STATS_SHARE) * free
    assert device.memory_needed(most, pixels, photos) <= room
    assert device.memory_needed(most + 1000, pixels, photos) > room
    assert device.largest_budget(1 * 2**30, pixels, photos) == 0, "the photos alone do not fit"


def test_backends_are_chosen_by_the_tensors_device() -> None:
    assert ops.backend_for(torch.zeros(1)) == "cpu"
    assert ops.backend_for(torch.zeros(1, device="meta")) == "cpu"


@pytest.mark.slow
def test_importing_the_package_imports_no_triton_and_starts_no_gpu() -> None:
    program = (
        "import sys, torch, splatmill_worker.kernels.ops, splatmill_worker.kernels.gpu.device, "
        "splatmill_worker.splat.engine.protocol, splatmill_worker.pipeline\n"
        "assert 'triton' not in sys.modules, 'triton was imported'\n"
        "assert not torch.cuda.is_initialized(), 'a GPU was touched'\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr

"""Decoding processes: those of this process, and such as can also be asked for the acts of `forbidden_acts`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

from splatmill_worker.images.decoding import decoder_process

_PROGRAM = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("splatmill_worker.acts", {path!r})
acts = importlib.util.module_from_spec(spec)
sys.modules["splatmill_worker.acts"] = acts
spec.loader.exec_module(acts)
from splatmill_worker.images.decoding import decoder
decoder.main()
"""


def acts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Let the decoding processes that start from now on know the acts, and return them as they are called there."""
    path = Path(__file__).with_name("forbidden_acts.py")
    monkeypatch.setattr(
        decoder_process, "_COMMAND", (sys.executable, "-IB", "-c", _PROGRAM.format(path=str(path)))
    )
    from tests.support.decoding import forbidden_acts

    for value in vars(forbidden_acts).values():
        if callable(value) and getattr(value, "__module__", None) == forbidden_acts.__name__:
            monkeypatch.setattr(value, "__module__", "splatmill_worker.acts")
    return forbidden_acts


def children() -> list[int]:
    """The ids of this process's decoding processes."""
    pids = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return [
        pid
        for pid in map(int, pids)
        if b"images.decoding.decoder" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]

"""Checkpoints on disk: whole or not there, so that a killed attempt goes on from the last one."""

from __future__ import annotations

import os
import pickle
import tempfile
from pathlib import Path
from typing import Any

import torch

NAME = "checkpoint.pt"
FORMAT = 1


def save(directory: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint in `directory` by `state` (plain values and tensors), atomically and synced."""
    directory.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=directory, prefix=f".{NAME}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            torch.save({"format": FORMAT, **state}, stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, directory / NAME)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    folder = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(folder)  # the rename itself must survive a power cut
    finally:
        os.close(folder)


def load(directory: Path) -> dict[str, Any] | None:
    """The last checkpoint; None when there is none, or none that this version can read.

    Only tensors and plain values are unpickled: a checkpoint may come from a shared folder.
    """
    path = directory / NAME
    if not path.is_file():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, OSError, pickle.UnpicklingError):
        return None
    return state if state.get("format") == FORMAT else None

"""Snapshots of a training run on disk, written atomically, so that a killed attempt resumes from the last one."""

from __future__ import annotations

import logging
import pickle
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from splatmill.files import replacing
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.snapshot import RunState, Snapshot

NAME = "checkpoint.pt"
log = logging.getLogger("splatmill_worker")

FORMAT = 1
"""Number of the file's format: the keys of `_encoded`. A file with another number is not read."""

TENSORS = ("parameters", "exp_avg", "exp_avg_sq", "poses", "random")
"""Fields of a snapshot that are stored under their own names."""

NAMES = {"curve": "rows", "upcoming": "order", "max_gaussians": "most", "ever_visible": "ever_saw"}
"""Names in the file of the fields of a state that have another one there."""


def save(directory: Path, snapshot: Snapshot) -> None:
    """Replace the checkpoint in `directory`, atomically and synced. Raises OSError where that fails."""
    with replacing(directory / NAME, sync=True) as part, part.open("wb") as file:
        stream = _Stream(file)
        try:
            torch.save(_encoded(snapshot), cast(BinaryIO, stream))  # torch calls write and flush alone
        except RuntimeError as error:
            # torch's own text says nothing of the disk
            raise (stream.error or error) from error


class _Stream:
    """A file for torch to write to, which keeps the error of a write that failed."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.error = error
            raise

    def flush(self) -> None:
        self._file.flush()


def load(directory: Path) -> Snapshot | None:
    """The last checkpoint; None where there is none, or none that this version can read.

    Only tensors and plain values are unpickled: a checkpoint may come from a shared folder.
    """
    path = directory / NAME
    if not path.is_file():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        if state.get("format") != FORMAT:
            raise ValueError(f"it has format {state.get('format')}, and this version reads {FORMAT}")
        return _decoded(state)
    except (
        *(RuntimeError, EOFError, ValueError, OSError, KeyError, TypeError, AttributeError),
        pickle.UnpicklingError,
    ) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        log.warning("The checkpoint cannot be used, so training starts anew: %s", text)
        return None


def _encoded(snapshot: Snapshot) -> dict[str, Any]:
    """The file's plain values and tensors by key."""
    state = asdict(snapshot.state)
    return {
        "format": FORMAT,
        **{name: getattr(snapshot, name) for name in TENSORS},
        "seconds": snapshot.seconds,
        "views": list(snapshot.view_names),
        "best": None if snapshot.best is None else _encoded(snapshot.best),
        **{NAMES.get(name, name): list(v) if isinstance(v, tuple) else v for name, v in state.items()},
    }


def _decoded(state: dict[str, Any]) -> Snapshot:
    state = {"limited": False} | state  # files of before have none
    values = {name: state[NAMES.get(name, name)] for name in (each.name for each in fields(RunState))}
    values["budget"] = Budget(**values["budget"])
    values["curve"] = tuple(CurvePoint(**row) for row in values["curve"])
    values["upcoming"] = tuple(values["upcoming"])
    return Snapshot(
        **{name: state[name] for name in TENSORS},
        state=RunState(**values),
        seconds=state["seconds"],
        view_names=tuple(state["views"]),
        best=_decoded(state["best"]) if state.get("best") else None,
    )

"""The models of a cluster of photos, mapped apart from the others and kept beside COLMAP's database."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.mapping import mapper

CLUSTERS = "clusters"
"""Folder beside COLMAP's database with a folder of models for each cluster."""


def mapped_cluster(
    database_path: Path,
    images: Sequence[int],
    threads: int,
    seed: int,
    *,
    on_progress: Callable[[int], None],
    on_model: Callable[[pycolmap.Reconstruction], None],
    cancelled: Callable[[], bool],
) -> list[pycolmap.Reconstruction]:
    """The models of a cluster of the photos in COLMAP's database, the largest first: those that are stored, or else
    those of the incremental mapper, which are stored.

    images: COLMAP's ids of its photos.
    on_progress: called with the number of photos that are placed.
    on_model: called with the model that grows.

    Raises Cancelled between two steps, and OSError where the models cannot be stored.
    """
    folder = folder_of(database_path, images)
    if folder.is_dir():
        try:
            stored = _read(folder)
        except (OSError, ValueError, RuntimeError, IndexError):  # the file system has lost a part of them
            shutil.rmtree(folder)
        else:
            on_progress(len(images))
            return stored
    models = mapper.models_of(
        database_path,
        images,
        threads,
        seed,
        on_progress=lambda placed, total, note: on_progress(placed),
        on_model=on_model,
        cancelled=cancelled,
    )
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for index, model in enumerate(models):
        partial.joinpath(str(index)).mkdir()
        write_model(model, partial / str(index))
    stop_if(cancelled)
    os.replace(partial, folder)
    return _read(folder)  # as another process reads them


def folder_of(database_path: Path, images: Sequence[int]) -> Path:
    """Where the models of a cluster lie: another choice of photos has another folder."""
    name = hashlib.sha256(repr((pycolmap.__version__, sorted(images))).encode()).hexdigest()[:16]
    return database_path.parent / CLUSTERS / name


def _read(folder: Path) -> list[pycolmap.Reconstruction]:
    folders = sorted(folder.iterdir(), key=lambda path: int(path.name))
    return [pycolmap.Reconstruction(path) for path in folders]

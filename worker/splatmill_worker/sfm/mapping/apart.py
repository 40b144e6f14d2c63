"""Mapping of a large capture in clusters: each apart, and all of them joined."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.mapping import mapper

APART = "apart"
"""Folder beside COLMAP's database with the models of each cluster."""


def map_cluster(
    database_path: Path,
    number: int,
    images: Sequence[int],
    threads: int,
    seed: int,
    *,
    on_progress: Callable[[int], None],
    on_model: Callable[[pycolmap.Reconstruction], None],
    cancelled: Callable[[], bool],
) -> None:
    """Map a cluster of the photos in COLMAP's database with the incremental mapper, and leave its models beside that.

    number: of the cluster, from 0.
    images: COLMAP's ids of its photos.
    on_progress: called with the number of photos that are placed.
    on_model: called with the model that grows.

    A cluster whose models are there is not mapped again. Raises Cancelled between two steps.
    """
    folder = folder_of(database_path, number)
    if folder.is_dir():
        on_progress(len(images))
        return
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


def folder_of(database_path: Path, number: int) -> Path:
    """Where the models of a cluster lie."""
    return database_path.parent / APART / str(number)


def stored_models(database_path: Path, number: int) -> list[pycolmap.Reconstruction]:
    """The models of a cluster, the largest first."""
    folders = sorted(folder_of(database_path, number).iterdir(), key=lambda path: int(path.name))
    return [pycolmap.Reconstruction(path) for path in folders]

"""Finds the data set in a capture that is a single zip: photos, masks and cameras as tools lay them out in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from splatmill.data_sets import MAX_DEPTH, TwoDataSets
from splatmill.schema.files.formats import is_start_file
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES
from splatmill_worker.images import prepare
from splatmill_worker.images.archives.archive import REMARK, Allowance
from splatmill_worker.images.masks import mask_folder
from splatmill_worker.sfm.posed.capture import find
from splatmill_worker.sfm.posed.programs import TwoFiles


def data_set(capture: Path, workdir: Path, cancelled: Callable[[], bool] = lambda: False) -> Path:
    """The folder to read a capture from: that of the unpacked data set if the capture is a zip of one, else `capture`.

    A capture is a zip of a data set if a single zip is its only file besides models to start from, and the zip holds
    cameras (transforms*.json or a COLMAP model), or the folders images/ and masks/. Other zips hold photos, which
    `prepare` finds. It unpacks to the same folder in `workdir`, so nothing is unpacked twice.

    Raises Refusal for an archive that unpacks to too much, and Cancelled.
    """
    images = prepare.given_files(capture / "images")
    others = [path for folder in ("masks", "poses") for path in prepare.given_files(capture / folder)]
    if len(images) != 1 or images[0].suffix.lower() not in ARCHIVE_SUFFIXES or images[0].is_symlink():
        return capture
    if any(not is_start_file(path.name) for path in others):
        return capture
    try:
        folder = prepare.unpacked(images[0].name, images[0], workdir, Allowance(), cancelled)
    except ValueError:
        return capture  # `prepare` names the reason for which the zip is not used
    for _ in range(MAX_DEPTH):
        if _is_data_set(folder):
            return folder
        inside = sorted(path for path in folder.iterdir() if path.name != REMARK)
        if len(inside) != 1 or not inside[0].is_dir():
            break
        folder = inside[0]
    return capture


def _is_data_set(folder: Path) -> bool:
    masked = (folder / "images").is_dir() and mask_folder(folder) is not None
    try:
        return masked or find(folder) is not None
    except (TwoDataSets, TwoFiles):
        return True  # whoever reads it says so

"""Finds the data set in a capture that is a single zip, and the cameras in zips that lie among loose photos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatmill.data_sets import (
    MAX_DEPTH,
    TwoDataSets,
    holds_media,
    not_used_in_zip,
    program_files,
    walk,
)
from splatmill.schema.files.formats import is_start_file
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES
from splatmill_worker.images import prepare
from splatmill_worker.images.archives.archive import REMARK, Allowance
from splatmill_worker.images.masks import mask_folder
from splatmill_worker.readers.programs import reading
from splatmill_worker.sfm.posed.capture import PosedInput, find
from splatmill_worker.sfm.posed.programs import TwoFiles, unrecognised


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


def cameras_beside(
    capture: Path, workdir: Path, cancelled: Callable[[], bool] = lambda: False
) -> PosedInput | None:
    """The cameras in a zip that lies among loose photos and has none of its own; None where no zip has any.

    Raises as `data_set` does, and TwoFiles where two zips have cameras, or one has two of a program.
    """
    inputs: dict[str, PosedInput] = {}
    for name, folder in _zips_among_photos(capture, workdir, cancelled).items():
        if not holds_media(walk(folder)) and (cameras := find(capture, folder)) is not None:
            notes = (f"The cameras are those in {name}.", *cameras.notes)
            inputs[name] = replace(cameras, notes=notes, archive=name, unpacked=folder)
    if len(inputs) > 1:
        first, second, *_ = inputs
        raise TwoFiles(f"Cameras are in {first} and in {second}. Leave one of them out.")
    return next(iter(inputs.values()), None)


def unused_cameras(capture: Path, workdir: Path, cancelled: Callable[[], bool] = lambda: False) -> list[str]:
    """Sentences about cameras of other programs in zips that lie among other files, where no cameras are used.

    `prepare` names the other kinds. Raises as `data_set` does.
    """
    said = []
    for name, folder in _zips_among_photos(capture, workdir, cancelled).items():
        names = program_files(walk(folder))
        own = [each for each in names if reading.kind_of(folder / each) is not None]
        said += [not_used_in_zip(name, own[0], posed=False)] if own else unrecognised(folder, names)
    return said


def _zips_among_photos(capture: Path, workdir: Path, cancelled: Callable[[], bool]) -> dict[str, Path]:
    """The folder with the content of each zip that is not the only file of photos, by the name of the zip."""
    images = prepare.given_files(capture / "images")
    allowance = Allowance()
    folders: dict[str, Path] = {}
    for path in images if len(images) > 1 else ():
        if path.suffix.lower() not in ARCHIVE_SUFFIXES or path.is_symlink():
            continue
        name = path.relative_to(capture / "images").as_posix()
        try:
            folders[name] = prepare.unpacked(name, path, workdir, allowance, cancelled)
        except ValueError:
            continue  # `prepare` names the reason for which the zip is not used
    return folders


def _is_data_set(folder: Path) -> bool:
    masked = (folder / "images").is_dir() and mask_folder(folder) is not None
    try:
        return masked or find(folder) is not None
    except (TwoDataSets, TwoFiles):
        return True  # whoever reads it says so

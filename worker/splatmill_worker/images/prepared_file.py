"""The photos of a capture as `prepare` found them, in a folder that other processes and machines read."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from splatmill_worker.images.prepare import Prepared, UsablePhoto
from splatmill_worker.scene import Overlay

FILE = "photos.json"
"""The file; masks that were made from the photos lie beside it."""

CAPTURE, OVERLAYS = "capture", "overlays"
"""The first parts of stored paths: below the folder of the capture, and below that of the file."""

_PHOTO = TypeAdapter(UsablePhoto)


def can_be_stored(prepared: Prepared, capture: Path) -> bool:
    """Whether all photos are files of `capture`. Those of zips and videos are unpacked, which each process does."""
    return all(photo.path.is_relative_to(capture) for photo in prepared.photos)


def store(prepared: Prepared, capture: Path, folder: Path) -> None:
    """Write the photos, which are files of `capture`, to `folder`, with the masks that were made of them."""
    photos = [
        _PHOTO.dump_python(photo, mode="json")
        | {
            "path": f"{CAPTURE}/{photo.path.relative_to(capture).as_posix()}",
            "mask": _stored_mask(photo.mask, capture, folder),
            # Of which other machines need no file, to know by which name features are kept.
            "mask_sha256": photo.hash_of_mask(),
        }
        for photo in prepared.photos
    ]
    overlays = [
        dataclasses.asdict(overlay) | {"region": overlay.region.tolist()} for overlay in prepared.overlays
    ]
    sentences = {name: getattr(prepared, name) for name in ("skipped", "notes", "warnings")}
    document = {"photos": photos, "overlays": overlays, **sentences}
    (folder / FILE).write_text(json.dumps(document), "utf-8")


def load(folder: Path, capture: Path) -> Prepared:
    """The photos that `store` wrote to `folder`, of which `capture` has the files. Raises ValueError and OSError."""
    document: dict[str, Any] = json.loads((folder / FILE).read_text("utf-8"))
    roots = {CAPTURE: capture, OVERLAYS: folder / OVERLAYS}

    def file_of(path: str) -> Path:
        root, _, name = path.partition("/")
        return roots[root] / name

    photos = tuple(
        dataclasses.replace(
            _PHOTO.validate_python(photo),
            path=file_of(photo["path"]),
            mask=None if photo["mask"] is None else file_of(photo["mask"]),
        )
        for photo in document["photos"]
    )
    overlays = tuple(
        Overlay(tuple(each["photos"]), each["caption"], np.array(each["region"], bool))
        for each in document["overlays"]
    )
    skipped = tuple((name, reason) for name, reason in document["skipped"])
    return Prepared(photos, skipped, tuple(document["notes"]), tuple(document["warnings"]), overlays)


def _stored_mask(mask: Path | None, capture: Path, folder: Path) -> str | None:
    """The stored path of a mask, which is copied into `folder` where it is no file of the capture."""
    if mask is None:
        return None
    if mask.is_relative_to(capture):
        return f"{CAPTURE}/{mask.relative_to(capture).as_posix()}"
    target = folder / OVERLAYS / mask.name
    if not target.is_file():
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(mask, target)
    return f"{OVERLAYS}/{mask.name}"

"""A small input as people have them, and what the command line and the worker make of it short of any training."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from splatmill.data_sets import TwoDataSets
from splatmill.errors import NothingToUpload
from splatmill.schema import Role, TrainOptions
from splatmill.transfer.local_capture import find_files
from splatmill_worker.errors import WorkerError
from splatmill_worker.images.masks import mask_folder
from splatmill_worker.images.prepare import names_remark, prepare
from splatmill_worker.pipeline.depth.given_depth import with_depth
from splatmill_worker.scene import Scene, omissions
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import zipped

Kind = Literal["used", "used with a remark", "refused"]

CAMERAS = {
    "colmap": "of a COLMAP model",
    "transforms": "of transforms.json",
    "blender": "of a Blender data set",
    "program": "of another program",
    "sfm": "to be recovered",
}


@dataclass(frozen=True)
class Example:
    """An input: its area on the page, what it is, a function that makes it in a folder, and the kind of the answer."""

    area: str
    what: str
    make: Callable[[Path], object]
    kind: Kind


@dataclass(frozen=True)
class Answer:
    """What comes of an input: its kind, and sentences."""

    kind: Kind
    said: tuple[str, ...]


@cache
def answer(make: Callable[[Path], object]) -> Answer:
    """Return the messages about the input that `make` makes in a folder, before cameras are recovered and trained.

    They are kept: the page of inputs and the test of each answer ask for the same.
    """
    with tempfile.TemporaryDirectory(prefix="splatmill-example-") as name:
        root = Path(name)
        folder, capture, work = (root / part for part in ("photos", "capture", "work"))
        folder.mkdir()
        make(folder)
        try:
            listing = find_files(folder)
            for file in listing.files:
                stored = capture / file.role / file.name
                stored.parent.mkdir(parents=True, exist_ok=True)
                stored.write_bytes(file.path.read_bytes())
            count, source, masks, said = _read(capture, work)
        except (NothingToUpload, WorkerError, ValueError, TwoDataSets) as error:
            text = str(error).replace(f"{folder}", "The folder")
            return Answer(
                "refused", (text, *(note for each in work.glob("unpacked/*") for note in names_remark(each)))
            )
    renamed = [f"{before!a} is stored as {after}." for before, after in listing.renamed]
    results = [f"A result of an earlier training, not a photo: {path}." for path in listing.outputs]
    remarks = tuple(dict.fromkeys((*listing.remarks, *renamed, *results, *said)))
    hidden = f" and {masks} masks" if masks else ""
    used = f"{count} photos{hidden}, cameras {CAMERAS[source]}."
    return Answer("used with a remark" if remarks else "used", (used, *remarks))


def _read(capture: Path, work: Path) -> tuple[int, str, int, list[str]]:
    """Photos, source of the cameras, masks, and sentences: warnings, and why files are left out."""
    capture = zipped.data_set(capture, work)
    source = posed.find(capture) or zipped.cameras_beside(capture, work)
    if source is not None:
        scene: Scene = source.load()
        names = {view.name for view in scene.views}
        quiet = lambda *_: None  # noqa: E731
        scene = with_depth(scene, names, capture, work, TrainOptions(), quiet, lambda: False)
        masks = sum(view.mask is not None for view in scene.views)
        return len(scene.views), scene.source, masks, [*scene.warnings, *omissions(scene.left_out)]
    prepared = prepare(capture / Role.images, mask_folder(capture), work)
    masks = sum(photo.mask is not None for photo in prepared.photos)
    unread = [*posed.without_cameras(capture), *zipped.unused_cameras(capture, work)]
    return len(prepared.photos), "sfm", masks, [*unread, *prepared.warnings, *omissions(prepared.skipped)]

"""Proves that examined photos are read back as they were, on a machine where the capture lies elsewhere.

Does not prove what `prepare` finds (tests/worker/images/test_images.py).
"""

from __future__ import annotations

import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatmill_worker.images import prepared_file
from splatmill_worker.images.exif import Exif
from splatmill_worker.images.image_circle import Circle
from splatmill_worker.images.prepare import prepare
from splatmill_worker.scene import Overlay


def written(capture: Path, count: int = 3) -> Path:
    """A capture with photos, of which the first has a mask, and a file that is none."""
    random = np.random.default_rng(0)
    for folder in ("images/left", "masks/left"):
        (capture / folder).mkdir(parents=True)
    for number in range(count):
        Image.fromarray(random.integers(0, 255, (60, 80, 3), np.uint8)).save(
            capture / "images" / "left" / f"{number} ü.png"
        )
    shown = np.full((60, 80), 255, np.uint8)
    shown[:20] = 0
    Image.fromarray(shown).save(capture / "masks" / "left" / "0 ü.png")
    (capture / "images" / "notes.txt").write_text("of the place")
    return capture


def test_photos_are_read_back_where_the_capture_lies_now(tmp_path: Path) -> None:
    capture, work, out = written(tmp_path / "here"), tmp_path / "work", tmp_path / "out"
    out.mkdir()
    prepared = prepare(capture / "images", capture / "masks", work)
    made = work / "overlays" / "1.png"
    made.parent.mkdir(parents=True)
    shutil.copyfile(prepared.photos[0].mask or Path(), made)
    one, two, three = prepared.photos
    tags = Exif(make="M", focal_length=4.2, latitude=-0.0, longitude=1e-9)
    original = replace(
        prepared,
        photos=(one, replace(two, mask=made, circle=Circle(0.5, 0.4, 0.3)), replace(three, exif=tags)),
        notes=("a note",),
        overlays=(Overlay(("left/1 ü.png",), "a logo", np.array([[True, False]])),),
    )
    assert one.mask is not None
    assert prepared.skipped
    assert prepared_file.can_be_stored(original, capture)
    prepared_file.store(original, capture, out)
    key = original.key
    shutil.rmtree(work)
    there, moved = tmp_path / "there", tmp_path / "moved"
    capture.rename(there)
    out.rename(moved)
    back = prepared_file.load(moved, there)
    assert back.photos[0].path == there / "images" / "left" / "0 ü.png"
    assert back.photos[0].mask == there / "masks" / "left" / "0 ü.png"
    assert back.photos[1].mask == moved / "overlays" / "1.png"
    assert back.overlays[0].region.tolist() == [[True, False]]
    assert [replace(photo, path=Path(), mask=None, mask_sha256=None) for photo in back.photos] == [
        replace(photo, path=Path(), mask=None) for photo in original.photos
    ]
    assert (back.skipped, back.notes, back.warnings) == (original.skipped, original.notes, original.warnings)
    shutil.rmtree(there)
    shutil.rmtree(moved)
    assert back.key == key, "without any file"


def test_photos_of_a_zip_are_not_stored(tmp_path: Path) -> None:
    capture = written(tmp_path / "capture")
    with zipfile.ZipFile(capture / "images" / "more.zip", "w") as archive:
        archive.write(capture / "images" / "left" / "1 ü.png", "inside.png")
    (capture / "images" / "left" / "1 ü.png").unlink()
    prepared = prepare(capture / "images", None, tmp_path / "work")
    assert len(prepared.photos) == 3
    assert not prepared_file.can_be_stored(prepared, capture)

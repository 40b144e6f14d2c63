"""Photos under names and suffixes that programs and cameras give, and beside the results of an earlier training.

Does not prove names in zips and in uploads of the browser; tests/worker/images and tests/browser do.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from PIL import Image

from splatmill.schema import Role
from splatmill.transfer.local_capture import find_files
from splatmill_worker.images.prepare import prepare
from tests.inputs.conftest import Build
from tests.support.command_line import spawn

pytestmark = pytest.mark.slow


def smaller(photo: Path) -> None:
    """Make a photo of 320 x 240 pixels: its features take half the time, and cameras are still recovered at once."""
    with Image.open(photo) as whole:
        small, exif = whole.resize((320, 240), Image.Resampling.LANCZOS), whole.getexif()
    small.save(photo, quality=95, exif=exif)


def test_photos_under_bad_names_train_and_the_results_among_them_are_no_photos(
    built: Build, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    shutil.copytree(built("output-among-photos"), folder)
    names = sorted(os.listdir(os.fsencode(folder)))
    for photo in folder.glob("*.jpg"):
        smaller(photo)
    for bad, name in zip([b"x:1.jpg", b" lead.jpg", b"caf\xe9.jpg"], names[3::8], strict=False):
        os.rename(os.path.join(os.fsencode(folder), name), os.path.join(os.fsencode(folder), bad))
    options = ("--image-size", "160", "--steps", "10", "-v")
    told, said = spawn("train", folder, "-o", folder / "splat", *options).communicate(timeout=600)
    for name in ("'x:1.jpg'", "' lead.jpg'", "'caf\\udce9.jpg'"):
        assert f"renamed: {name}" in told + said
    assert (folder / "splat/preview.jpg").is_file(), said
    again = find_files(folder)
    assert again.count(Role.images) == 30
    assert any(Path(path).parts[0] == "splat" for path in again.outputs)


def test_photos_called_jfif_are_used(built: Build, tmp_path: Path) -> None:
    assert len(prepare(built("picture-kinds") / "jfif", None, tmp_path).photos) == 30

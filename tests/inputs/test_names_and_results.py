"""Photos under names and suffixes that programs and cameras give, and beside the results of an earlier training.

Does not prove names in zips and in uploads of the browser; tests/worker/images and tests/browser do.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.inputs.conftest import PLAIN_WITHOUT_CAMERAS, Build, Train
from tests.support.command_line import spawn

pytestmark = pytest.mark.slow


def test_the_results_of_the_first_run_are_no_photos_of_the_second(
    built: Build, trained: Train, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    shutil.copytree(built("output-among-photos"), folder)
    options = ("--image-size", "320", "--steps", "10")
    _, said = spawn("train", folder, "-o", folder / "splat", *options).communicate(timeout=600)
    assert (folder / "splat/preview.jpg").is_file(), said
    second = trained(folder)
    assert len(second.report["views"]) == 30
    assert "results of an earlier training, not read as photos: splat/" in second.output
    assert second.psnr > PLAIN_WITHOUT_CAMERAS - 0.5


def test_photos_called_jfif_train(built: Build, trained: Train) -> None:
    result = trained(built("picture-kinds") / "jfif")
    assert len(result.report["views"]) == 30
    assert result.psnr > PLAIN_WITHOUT_CAMERAS - 0.5


def test_photos_under_bad_names_are_renamed_and_said(built: Build, trained: Train, tmp_path: Path) -> None:
    folder = os.fsencode(tmp_path / "photos")
    shutil.copytree(built("output-among-photos"), os.fsdecode(folder))
    names = sorted(os.listdir(folder))
    for bad, name in zip([b"x:1.jpg", b" lead.jpg", b"caf\xe9.jpg"], names[3::8], strict=False):
        os.rename(os.path.join(folder, name), os.path.join(folder, bad))
    result = trained(Path(os.fsdecode(folder)), "--image-size", "160", "--steps", "10")
    assert len(result.report["views"]) == 30
    assert all(
        f"renamed: {name}" in result.output for name in ("'x:1.jpg'", "' lead.jpg'", "'caf\\udce9.jpg'")
    )

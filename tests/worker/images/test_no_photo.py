"""Proves that a capture of nothing but masks, depth maps, normal maps or labels is refused by its pixels, whatever its
folder is called, and that photos, also grey, plain and pale ones, are not taken for these.

Not proven here: depth maps in 8 bits and in colours, which only the name of their folder gives away.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageFilter

from splatmill_worker.errors import Refusal
from splatmill_worker.images.no_photo import kind_of
from splatmill_worker.images.prepare import prepare
from tests.support import still_life
from tests.support.paths import DATA

WIDTH, HEIGHT = 96, 72


def disc(k: int) -> npt.NDArray[np.bool_]:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray((x - 48 - 3 * k) ** 2 + (y - 36) ** 2 < (20 + k) ** 2)


def mask(k: int) -> Image.Image:
    return Image.fromarray(np.where(disc(k), 255, 0).astype(np.uint8))


def labels(k: int) -> Image.Image:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return Image.fromarray(np.where(disc(k), 7, (x + 5 * k) // 24 + 2 * (y // 36)).astype(np.uint8) * 20)


def depth(k: int) -> Image.Image:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return Image.fromarray((1000 + 7 * x + 3 * y + 500 * disc(k)).astype(np.uint16))


def normals(k: int) -> Image.Image:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    dx, dy, r = x - 48 - 3 * k, y - 36, 30.0 + k
    z = np.sqrt(np.clip(r * r - dx * dx - dy * dy, 0, None))
    colors = 127.5 * (1.0 + np.stack([dx, -dy, z], axis=-1) / r)
    return Image.fromarray(np.where((z > 0)[..., None], colors, 0).astype(np.uint8))


KINDS = {
    "masks": (mask, ".png", "masks"),
    "masks as JPEG": (mask, ".jpg", "masks"),
    "masks of labels 0 and 1": (lambda k: mask(k).point(lambda level: level // 255), ".png", "masks"),
    "masks with soft edges": (lambda k: mask(k).filter(ImageFilter.GaussianBlur(0.5)), ".png", "masks"),
    "depth maps": (depth, ".png", "depth maps"),
    "depth maps as TIFF": (depth, ".tif", "depth maps"),
    "confidence maps": (lambda k: labels(k).point(lambda level: level // 60), ".png", "pictures of labels"),
    "segmentation": (labels, ".png", "pictures of labels"),
    "normal maps": (normals, ".png", "normal maps"),
}


@pytest.mark.parametrize(("made", "suffix", "kind"), KINDS.values(), ids=KINDS.keys())
def test_a_capture_of_nothing_else_is_refused(tmp_path: Path, made, suffix: str, kind: str) -> None:
    (tmp_path / "images").mkdir()
    for k in range(4):
        made(k).save(tmp_path / "images" / f"{k}{suffix}")
    with pytest.raises(Refusal) as refused:
        prepare(tmp_path / "images", None, tmp_path / "work")
    assert str(refused.value).startswith(f"The 4 pictures seem to be {kind}, not photos: ")
    assert "Give the photos themselves" in str(refused.value.advice)
    assert "If these are the photos" in str(refused.value.advice)


def test_masks_in_a_zip_are_refused(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with zipfile.ZipFile(tmp_path / "images" / "set.zip", "w") as archive:
        for k in range(4):
            mask(k).save(tmp_path / f"{k}.png")
            archive.write(tmp_path / f"{k}.png", f"masks/{k}.png")
    with pytest.raises(Refusal, match=r"The 4 pictures seem to be masks, not photos"):
        prepare(tmp_path / "images", None, tmp_path / "work")


def test_photos_in_a_folder_called_masks_are_photos(tmp_path: Path) -> None:
    (tmp_path / "images" / "masks").mkdir(parents=True)
    for k, (_, rgb, _) in enumerate(still_life.pictures()[:4]):
        Image.fromarray(rgb).save(tmp_path / "images" / "masks" / f"{k}.png")
    assert len(prepare(tmp_path / "images", None, tmp_path / "work").photos) == 4


def test_a_depth_map_among_photos_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "images" / "confidence").mkdir(parents=True)
    for k, (_, rgb, _) in enumerate(still_life.pictures()[:4]):
        Image.fromarray(rgb).save(tmp_path / "images" / f"{k}.jpg")
        depth(k).save(tmp_path / "images" / f"{k}_d.png")
        labels(k).save(tmp_path / "images" / "confidence" / f"{k}.png")
    result = prepare(tmp_path / "images", None, tmp_path / "work")
    assert [photo.name for photo in result.photos] == [f"{k}.jpg" for k in range(4)]
    reasons = dict(result.skipped)
    assert reasons["2_d.png"] == (
        "it has a single channel of 16 bits, as depth maps have, which other photos have not"
    )
    assert reasons["confidence/2.png"] == "it lies in a folder of confidence maps"


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_photos_are_photos(mode: str) -> None:
    for _, rgb, _ in still_life.pictures():
        assert kind_of(mode, Image.fromarray(rgb).convert(mode)) == ""
    sky = np.full((72, 96, 3), (135, 206, 235)) + np.random.default_rng(0).integers(-6, 7, (72, 96, 3))
    assert kind_of("RGB", Image.new("RGB", (96, 72), (200, 190, 180))) == ""
    assert kind_of("RGB", Image.fromarray(np.vstack([sky, sky // 2]).astype(np.uint8))) == ""


def test_photos_of_real_captures_are_photos() -> None:
    if not DATA.is_dir():
        pytest.skip(f"{DATA} is not here.")
    for capture in (
        "fox_540x960/images",
        "lund_1024x768_gps",
        "lego_400/train",
        "kermit_640x480",
        "snowmiku_1008/images",
    ):
        paths = [path for path in sorted((DATA / capture).rglob("*")) if path.suffix in (".jpg", ".png")][::5]
        assert paths
        for path in paths:
            with Image.open(path) as photo:
                assert kind_of(photo.mode, photo.convert("RGB")) == "", path

"""Proves which files count as photos and how their pixels reach the trainer: formats, refusals by name, size,
orientation, alpha, masks, zips, undistortion. Videos are in test_video.

Not proven here: colour management (profiles are ignored by design) and cameras' raw formats.
"""

import importlib
import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.errors import CaptureIncomplete
from splatmill_worker.images import decode, lens
from splatmill_worker.images import prepare as prepare_module
from splatmill_worker.images.archives import archive
from splatmill_worker.images.load import load_view
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.scene import Camera, Lens, View


def picture(width: int = 64, height: int = 48, seed: int = 0) -> Image.Image:
    random = np.random.default_rng(seed)
    small = Image.fromarray(random.integers(0, 256, (6, 8, 3), np.uint8))
    return small.resize((width, height), Image.Resampling.BICUBIC)


def prepared(folder: Path, tmp_path: Path, masks: Path | None = None) -> Prepared:
    return prepare(folder, masks, tmp_path / "work")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    return folder


def reasons(result: Prepared) -> dict[str, str]:
    return dict(result.skipped)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tiff", "heic", "avif"])
def test_each_format_is_read(photos: Path, tmp_path: Path, suffix: str) -> None:
    picture().save(photos / f"a.{suffix}", quality=95)
    result = prepared(photos, tmp_path)
    assert [(photo.name, photo.width, photo.height) for photo in result.photos] == [(f"a.{suffix}", 64, 48)]
    pixels = np.asarray(decode.decode(result.photos[0].path).convert("RGB"), float)
    # HEIC and AVIF halve the colours' resolution, which this picture has much of.
    halved = suffix in ("heic", "avif")
    assert np.abs(pixels - np.asarray(picture(), float)).mean() < (8.0 if halved else 4.0)


@pytest.mark.parametrize("suffix", [".jfif", ".jpe", ".JFIF", ".avif"])
def test_photos_with_rare_suffixes_are_upright_and_truncated_ones_are_named(
    photos: Path, tmp_path: Path, suffix: str
) -> None:
    turned = Image.Exif()
    turned[decode.ORIENTATION] = 6
    form = "AVIF" if suffix == ".avif" else "JPEG"
    whole = picture(400, 300)
    whole.save(photos / f"a{suffix}", form, quality=95, exif=turned)
    data = (photos / f"a{suffix}").read_bytes()
    (photos / f"cut{suffix}").write_bytes(data[: len(data) // 2])
    result = prepared(photos, tmp_path)
    assert [(photo.name, photo.width, photo.height) for photo in result.photos] == [(f"a{suffix}", 300, 400)]
    assert reasons(result).keys() == {f"cut{suffix}"}
    assert "it does not decode completely" in reasons(result)[f"cut{suffix}"]
    pixels = np.asarray(decode.decode(photos / f"a{suffix}"), float)
    assert np.abs(pixels - np.asarray(whole.rotate(-90, expand=True), float)).mean() < 4.0


def test_unusable_files_are_named_with_their_reason(photos: Path, tmp_path: Path) -> None:
    picture().save(photos / "good.jpg")
    (photos / "same.jpg").write_bytes((photos / "good.jpg").read_bytes())
    (photos / "text.jpg").write_text("this is no photo")
    (photos / "empty.png").write_bytes(b"")
    data = io.BytesIO()
    picture(400, 300).save(data, "JPEG")
    (photos / "cut.jpg").write_bytes(data.getvalue()[: len(data.getvalue()) // 2])
    Image.new("RGB", (1, 1)).save(photos / "one.png")
    (photos / "notes.txt").write_text("hello")
    result = prepared(photos, tmp_path)
    assert [photo.name for photo in result.photos] == ["good.jpg"]
    skipped = reasons(result)
    assert skipped.keys() == {"same.jpg", "text.jpg", "empty.png", "cut.jpg", "one.png", "notes.txt"}
    assert "good.jpg" in skipped["same.jpg"]
    assert "not an image" in skipped["text.jpg"]
    assert "empty" in skipped["empty.png"]
    assert "does not decode completely" in skipped["cut.jpg"]
    assert "too small" in skipped["one.png"]


def test_a_link_is_named_and_its_target_not_read(photos: Path, tmp_path: Path) -> None:
    picture().save(tmp_path / "outside.png")
    (photos / "link.png").symlink_to(tmp_path / "outside.png")
    result = prepared(photos, tmp_path)
    assert result.photos == ()
    assert "link" in reasons(result)["link.png"]


def test_files_that_are_neither_used_nor_skipped_are_a_failure(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def expand(
        name: str, path: Path, inside: object, workdir: Path, frames: int, listing: Any, _: object
    ) -> None:
        if name != "b.png":
            listing.files.append((name, path, None))

    for seed, name in enumerate(("a.png", "b.png")):
        picture(seed=seed).save(photos / name)
    module = importlib.import_module("splatmill_worker.images.prepare")
    monkeypatch.setattr(module, "_expand", expand)
    with pytest.raises(CaptureIncomplete, match=r"1 of the 2 files of images/ .* 'b\.png'"):
        prepared(photos, tmp_path)


def test_an_oversized_photo_is_refused_by_its_header(photos: Path, tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    # 30,000 x 30,000 pixels announced, 10 bytes of data: decoding it would fail, so the size has to be the reason.
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    (photos / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    assert "30000 x 30000" in reasons(prepared(photos, tmp_path))["huge.png"]


def test_orientation_is_applied(photos: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned; upright is a quarter turn clockwise
    picture(64, 48).save(photos / "turned.png", exif=exif)
    photo = prepared(photos, tmp_path).photos[0]
    assert (photo.width, photo.height) == (48, 64)
    upright = np.asarray(decode.decode(photo.path))
    np.testing.assert_array_equal(upright, np.rot90(np.asarray(picture(64, 48)), -1))


def test_masks_are_found_in_their_folder_and_beside_the_photo(photos: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    half = np.zeros((48, 64), np.uint8)
    half[:, 32:] = 255
    for name, seed in (("a.jpg", 1), ("b.jpg", 2), ("c.jpg", 3)):
        picture(seed=seed).save(photos / name)
    Image.fromarray(half).save(masks / "a.jpg.png")
    Image.fromarray(half).save(masks / "b.png")
    Image.fromarray(half).save(photos / "c.jpg.png")
    result = prepared(photos, tmp_path, masks)
    assert [photo.name for photo in result.photos] == ["a.jpg", "b.jpg", "c.jpg"]
    for photo in result.photos:
        camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
        loaded = load_view(View(photo.name, camera, photo.path, photo.mask), 32)
        assert loaded.mask is not None
        np.testing.assert_array_equal(loaded.mask, half[::2, ::2] > 0)


def test_a_zip_is_unpacked(photos: Path, tmp_path: Path) -> None:
    data = io.BytesIO()
    picture().save(data, "PNG")
    with zipfile.ZipFile(photos / "set.zip", "w") as container:
        container.writestr("inner/a.png", data.getvalue())
        container.writestr("__MACOSX/inner/._a.png", b"resource fork")
    result = prepared(photos, tmp_path)
    assert [photo.name for photo in result.photos] == ["set/inner/a.png"]
    assert result.skipped == ()


@pytest.mark.parametrize("name", ["../out.png", "/out.png", "a/../../out.png", "C:\\out.png", "..\\out.png"])
def test_a_zip_that_points_outside_is_refused(photos: Path, tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(photos / "bad.zip", "w") as container:
        container.writestr(name, b"x")
    assert "outside" in reasons(prepared(photos, tmp_path))["bad.zip"]
    assert not list(tmp_path.rglob("out.png"))


def test_a_zip_with_a_link_is_refused(photos: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(photos / "bad.zip", "w") as container:
        entry = zipfile.ZipInfo("link.png")
        entry.external_attr = 0o120777 << 16
        container.writestr(entry, "/etc/passwd")
    assert "link" in reasons(prepared(photos, tmp_path))["bad.zip"]


def test_a_zip_bomb_is_refused_before_it_is_unpacked(photos: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(photos / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as container:
        container.writestr("zeros.png", bytes(64 * 2**20))
    assert "bomb" in reasons(prepared(photos, tmp_path))["bomb.zip"]
    assert sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()) < 2**20


def test_a_zip_that_understates_its_sizes_is_stopped_while_unpacking(tmp_path: Path) -> None:
    place = tmp_path / "liar.zip"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as container:
        container.writestr("a.png", bytes(range(256)) * 40)
    whole = place.read_bytes()
    true, claimed = struct.pack("<I", 256 * 40), struct.pack("<I", 100)
    place.write_bytes(whole.replace(true, claimed))
    with pytest.raises(archive.UnsafeArchive):
        archive.unpack(place, tmp_path / "target")
    assert sum(path.stat().st_size for path in (tmp_path / "target").rglob("*")) <= 10_240


def test_reduction_is_the_exact_mean_over_each_pixels_area(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    pixels = random.integers(0, 256, (30, 45, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    camera = Camera(45, 30, 40.0, 40.0, 22.5, 15.0, np.eye(4))
    photo = load_view(View("a", camera, tmp_path / "a.png"), 20)
    assert photo.rgb.shape == (13, 20, 3)
    # Each pixel repeated until both grids divide: 45 * 4 = 9 * 20 columns, 30 * 13 = 30 * 13 rows.
    fine = pixels.repeat(13, axis=0).repeat(4, axis=1).astype(np.float64)
    expected = fine.reshape(13, 30, 20, 9, 3).mean(axis=(1, 3))
    assert np.abs(photo.rgb - expected).max() <= 0.5 + 1e-3  # rounding to 8 bits
    assert photo.camera.fx == pytest.approx(40.0 * 20 / 45)


def test_alpha_is_kept_and_colour_is_not_taken_from_what_it_hides(tmp_path: Path) -> None:
    rgba = np.zeros((32, 32, 4), np.uint8)
    rgba[:, :, 0] = 255  # hidden pixels are red
    rgba[:, 15:] = (0, 200, 0, 255)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    view = View("a", Camera(32, 32, 30.0, 30.0, 16.0, 16.0, np.eye(4)), tmp_path / "a.png")
    photo = load_view(view, 16)
    assert photo.alpha is not None
    np.testing.assert_array_equal(photo.alpha[0, 6:9], [0, 128, 255])
    np.testing.assert_array_equal(photo.rgb[0, 7], [0, 200, 0])
    white = load_view(view, 16, background=(1.0, 1.0, 1.0))
    np.testing.assert_array_equal(white.rgb[0, 6], [255, 255, 255])
    # The cover of 0.5 is an exact mean of the file, before alpha was rounded to 128.
    np.testing.assert_array_equal(white.rgb[0, 7], [128, 228, 128])


def test_undistortion_makes_straight_lines_straight(tmp_path: Path) -> None:
    """A photo rendered through the distortion of a known lens shows, undistorted, what a pinhole would see."""
    glass = Lens("OPENCV", (300.0, 300.0, 160.0, 120.0, -0.12, 0.02, 0.001, -0.002), 320, 240)
    camera = lens.pinhole(glass, np.eye(4))

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:  # of the ray (x, y, 1)
        return 127.0 + 60.0 * np.sin(25.0 * x) + 60.0 * np.sin(25.0 * y)

    colmap = lens.colmap_camera(glass)
    u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    rays = np.asarray(colmap.cam_from_img(np.stack([u.ravel(), v.ravel()], 1)))
    distorted = pattern(rays[:, 0], rays[:, 1]).reshape(240, 320)
    Image.fromarray(np.repeat(distorted.round().astype(np.uint8)[:, :, None], 3, 2)).save(tmp_path / "a.png")
    photo = load_view(View("a", camera, tmp_path / "a.png", lens=glass), 160)
    at = photo.camera
    x = (np.arange(160) + 0.5 - at.cx) / at.fx
    y = (np.arange(120) + 0.5 - at.cy) / at.fy
    expected = pattern(*np.meshgrid(x, y))
    mask = photo.mask if photo.mask is not None else np.ones(expected.shape, bool)
    assert mask.mean() > 0.98
    # 8-bit rounding plus what averaging a sine over a pixel of 0.0067 radians takes away: under 1 of 255.
    assert np.abs(photo.rgb[:, :, 0] - expected)[mask].max() < 2.0


def test_a_photo_of_another_shape_than_its_camera_is_refused(tmp_path: Path) -> None:
    picture(64, 48).save(tmp_path / "a.png")
    view = View("a", Camera(64, 64, 60.0, 60.0, 32.0, 32.0, np.eye(4)), tmp_path / "a.png")
    with pytest.raises(ValueError, match="different shape"):
        load_view(view, 32)


def test_the_preview_of_a_raw_photo_is_no_photo(photos: Path, tmp_path: Path) -> None:
    picture().save(photos / "a.jpg")
    # A .dng is a TIFF whose first picture is a small preview.
    picture(256, 192).save(photos / "IMG_1.DNG", "TIFF")
    with zipfile.ZipFile(photos / "more.zip", "w") as archive_file:
        archive_file.write(photos / "IMG_1.DNG", "2.nef")
        archive_file.writestr("sfm/scene.mvs", "MVSI")
    result = prepared(photos, tmp_path)
    assert [photo.name for photo in result.photos] == ["a.jpg"]
    assert reasons(result)["IMG_1.DNG"] == reasons(result)["more/2.nef"] == "raw photos are not read"
    raw, cameras = result.warnings
    assert "raw photos: IMG_1.DNG and 1 more. Develop them as JPEG or TIFF" in raw
    assert "cameras of OpenMVS in more/sfm/scene.mvs are not read" in cameras


def test_a_photo_that_disappeared_is_left_out(tmp_path: Path) -> None:
    gone = prepare_module._inspect("gone.jpg", tmp_path / "gone.jpg", None)
    assert gone == "it cannot be read: No such file or directory"

"""Decoding in processes of their own: the same results, and what a file can do there."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from splatmill_worker.errors import Cancelled, UnusablePicture
from splatmill_worker.images import decode as here
from splatmill_worker.images import examine as examine_here
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.decoding.decoders import Decoders, confined
from splatmill_worker.images.prepare import prepare
from tests.support.decoding.acting import children
from tests.support.hostile.videos import video
from tests.support.waiting import wait_for


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with a JPEG and an AVIF that EXIF turns, a transparent PNG and a PNG with 16 bits."""
    folder = tmp_path / "photos"
    folder.mkdir()
    random = np.random.default_rng(5)
    turned = Image.Exif()
    turned[here.ORIENTATION] = 6
    colours = random.integers(0, 256, (96, 160, 4), np.uint8)
    Image.fromarray(colours[..., :3]).save(folder / "turned.jpg", exif=turned)
    Image.fromarray(colours[..., :3]).save(folder / "turned.avif", exif=turned)
    Image.fromarray(colours).save(folder / "transparent.png")
    Image.fromarray(random.integers(0, 65536, (96, 160)).astype(np.uint16)).save(folder / "deep.png")
    return folder


@pytest.fixture
def confinement(photos: Path) -> Iterator[Decoders]:
    with confined([photos]) as started:
        yield started


@pytest.mark.parametrize("name", ["turned.jpg", "turned.avif", "transparent.png", "deep.png"])
@pytest.mark.parametrize("at_least", [None, (20, 20)])
def test_pixels_are_those_of_this_process(
    name: str, at_least: tuple[int, int] | None, photos: Path, confinement: Decoders
) -> None:
    there, own = (f(photos / name, at_least=at_least) for f in (decoders.decode, here.decode))
    assert there.mode == own.mode
    assert np.array_equal(np.asarray(there), np.asarray(own))
    assert decoders.sizes(photos / name, name) == here.sizes(photos / name, name)
    examined = [examine(photos / name, name) for examine in (decoders.examine, examine_here.examine)]
    assert examined[0] == examined[1]
    first, second = (picture.small for picture in examined if isinstance(picture, examine_here.Picture))
    assert np.array_equal(first, second)


def test_a_folder_with_a_video_is_prepared_alike(tmp_path: Path, photos: Path) -> None:
    (photos / "walk.mp4").write_bytes(video())
    (photos / "broken.jpg").write_bytes((photos / "turned.jpg").read_bytes()[:500])
    own = prepare(photos, None, tmp_path / "own", frames=3)
    work = tmp_path / "work"
    work.mkdir()
    with confined([photos, work]):
        there = prepare(photos, None, work, frames=3)
    assert [photo.sha256 for photo in there.photos] == [photo.sha256 for photo in own.photos]
    assert [photo.exif for photo in there.photos] == [photo.exif for photo in own.photos]
    assert there.skipped == own.skipped
    assert there.skipped[0][0] == "broken.jpg"
    assert there.notes == own.notes


def test_a_decoder_has_no_secret_and_only_the_files_of_its_job(
    photos: Path, confinement: Decoders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("REDIS_URL", "redis://:planted-password@host/0")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "planted-secret")
    decoders.sizes(photos / "deep.png", "deep.png")
    (child,) = children()
    environment = Path(f"/proc/{child}/environ").read_bytes()
    assert b"PATH=" in environment
    assert b"planted" not in environment
    if confinement.held is not None and "files" in confinement.held:
        other = tmp_path / "other.png"
        other.write_bytes((photos / "deep.png").read_bytes())
        with pytest.raises(PermissionError):
            decoders.decode(other)


def test_photos_that_have_been_read_take_no_memory(photos: Path, confinement: Decoders) -> None:
    """Neither in the process that decoded them, whose memory is limited, nor in this one."""
    Image.new("L", (10_000, 10_000)).save(photos / "big.png")
    decoders.decode(photos / "deep.png")
    (child,) = map(psutil.Process, children())
    gc.collect()
    gc.disable()
    # What is free in the heap of this process, in which other tests ran, goes back to the system, and is not counted.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", int)
    trim(0)
    try:
        before = [process.memory_info().rss for process in (psutil.Process(), child)]
        for _ in range(3):
            assert decoders.decode(photos / "big.png").size == (10_000, 10_000)
        trim(0)
        assert psutil.Process().memory_info().rss < before[0] + 50_000_000
        # It writes an answer shortly before its memory is free.
        wait_for(lambda: child.memory_info().rss < before[1] + 50_000_000)
    finally:
        gc.enable()


def test_a_picture_that_takes_too_long_is_given_up(photos: Path, confinement: Decoders) -> None:
    big = photos / "big.png"
    Image.new("L", (12_000, 12_000)).save(big)
    with pytest.raises(UnusablePicture, match="decoding it took longer than 0 seconds"):
        decoders.call(here.pixels, big, None, True, check=here.picture_of, seconds=0.01)


def test_reading_a_video_is_cancelled(photos: Path, tmp_path: Path, confinement: Decoders) -> None:
    (photos / "walk.mp4").write_bytes(video(frames=600))
    with pytest.raises(Cancelled):
        decoders.keyframes(photos / "walk.mp4", tmp_path / "work" / "frames", 5, cancelled=lambda: True)
    assert children() == []


def test_no_process_is_left(photos: Path) -> None:
    with confined([photos]):
        decoders.sizes(photos / "deep.png", "deep.png")
        assert len(children()) == 1
    assert children() == []
    assert decoders.sizes(photos / "deep.png", "deep.png")[0] == (160, 96)  # in this process again


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the processes are found in /proc")

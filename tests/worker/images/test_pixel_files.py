"""Photos in files are those in memory, byte for byte; they take no memory of the process, and a full disk is an error.

Does not prove how soon the system reads pages again.
"""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill_worker.images import pixel_files
from splatmill_worker.images.load import load_views
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.scene import Camera, Lens, Normalization, View
from splatmill_worker.splat.views import TrainingView

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0, np.eye(4))


def views(folder: Path, count: int) -> list[View]:
    """Photos of which some have a mask, some are transparent, and some were taken through a lens."""
    random = np.random.default_rng(0)
    lens = Lens("SIMPLE_RADIAL", (60.0, 32.0, 24.0, 0.2), WIDTH, HEIGHT)
    made = []
    for index in range(count):
        photo, mask = folder / f"{index}.png", None
        channels = 4 if index % 3 == 1 else 3
        Image.fromarray(random.integers(256, size=(HEIGHT, WIDTH, channels), dtype=np.uint8)).save(photo)
        if index % 3 == 2:
            mask = folder / f"mask{index}.png"
            Image.fromarray(np.where(random.random((HEIGHT, WIDTH)) < 0.5, 255, 0).astype(np.uint8)).save(
                mask
            )
        made.append(View(photo.name, CAMERA, photo, mask, lens=lens if index % 4 == 3 else None))
    return made


@pytest.mark.parametrize("block", [pixel_files.BLOCK_BYTES, 2 * 4096, 100])
def test_the_pixels_are_those_in_memory(block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixel_files, "BLOCK_BYTES", block)
    photos = views(tmp_path, 12)
    frame = Normalization(1.0, np.zeros(3))
    files = PixelFiles(tmp_path)
    for size in (WIDTH, 20):
        counted: list[int] = []
        inside, filed = load_views(photos, size, told=counted.append), load_views(photos, size, files=files)
        assert counted == list(range(1, 13))
        for one, other in zip(inside, filed, strict=True):
            first, second = TrainingView.of(one, frame), TrainingView.of(other, frame, files)
            exposure = np.array([0.2, -0.3, 0.1])
            for a, b in (
                (first.full, second.full),
                (first.reduced(2), second.reduced(2)),
                (first.relit(exposure).full, second.relit(exposure).full),
            ):
                for plane in ("rgb", "alpha", "mask"):
                    x, y = getattr(a, plane), getattr(b, plane)
                    assert (x is None) is (y is None)
                    assert x is None or torch.equal(x, y), plane
            assert set(first.levels) == {1, 2}
            assert set(second.levels) == {1}, "reduced photos would take memory"


def test_photos_outlive_their_room_and_leave_no_file(tmp_path: Path) -> None:
    files = PixelFiles(tmp_path)
    values = np.arange(100_000, dtype=np.uint32).view(np.uint8)
    kept = [files.placed(values + np.uint8(each)) for each in range(5)]
    assert not list(tmp_path.iterdir())
    del files
    for each, photo in enumerate(kept):
        assert np.array_equal(photo, values + np.uint8(each))


def test_a_full_disk_is_an_error(tmp_path: Path) -> None:
    """And no signal that ends the process when a page is written to later."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, before[1]))
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)):
            PixelFiles(tmp_path).placed(np.zeros(2**21, np.uint8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def resident(values: torch.Tensor) -> float:
    """The share of the pages of a tensor, which begins with a page, that are in memory (mincore)."""
    pages = -(-values.nbytes // mmap.PAGESIZE)
    flags = (ctypes.c_ubyte * pages)()
    system = ctypes.CDLL(None, use_errno=True)
    address = ctypes.c_void_p(values.data_ptr())
    assert system.mincore(address, ctypes.c_size_t(values.nbytes), flags) == 0, ctypes.get_errno()
    return sum(each & 1 for each in flags) / pages


@pytest.mark.skipif(sys.platform != "linux", reason="pages are written out by an advice of Linux")
def test_what_the_system_has_written_out_is_read_ahead(tmp_path: Path) -> None:
    files = PixelFiles(tmp_path)
    first, second = (torch.from_numpy(files.placed(np.full(2**21, value, np.uint8))) for value in (7, 9))
    (_, block) = files._blocks[0]
    block.flush()
    page_out = 21  # MADV_PAGEOUT of Linux 5.4
    deadline = time.monotonic() + 20.0
    while resident(first) + resident(second) > 0.0:
        try:
            block.madvise(page_out)
        except OSError:
            pytest.skip("this system does not write pages out when asked to")
        if time.monotonic() > deadline:
            pytest.skip("the file system of the temporary folder keeps pages in memory")
    files.read_ahead(second)
    while resident(second) < 1.0:
        assert time.monotonic() < deadline, "what was read ahead does not come"
    assert resident(first) < 0.5, "what was not asked for came too"
    assert bool((first == 7).all())
    assert bool((second == 9).all())


MEASURED = """
import json, os, sys
from pathlib import Path
from splatmill_worker import memory
from splatmill_worker.__main__ import return_freed_memory
from splatmill_worker.images.load import load_views
from splatmill_worker.images.pixel_files import PixelFiles
from tests.worker.images.test_pixel_files import CAMERA, frozen

return_freed_memory()
folder, place = Path(sys.argv[1]), sys.argv[2]
photos = frozen(folder)
load_views(photos[:8], 1200, threads=1)
memory.return_freed()
before = sum(memory._memory_of(os.getpid()))
loaded = load_views(photos, 1200, threads=1, files=PixelFiles(folder) if place == "files" else None)
memory.return_freed()
taken = sum(memory._memory_of(os.getpid())) - before
print(json.dumps([taken, sum(photo.rgb.nbytes for photo in loaded), int(sum(int(p.rgb.sum()) for p in loaded))]))
"""


def frozen(folder: Path) -> list[View]:
    """Sixty views of one photo of 1200x900 pixels."""
    camera = CAMERA.scaled_to(1200, 900)
    return [View(f"{index}.jpg", camera, folder / "one.jpg") for index in range(60)]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_photos_in_files_take_no_memory(tmp_path: Path) -> None:
    """194 MB of photos, which take as much in memory, and leave nothing in the heap."""
    random = np.random.default_rng(0)
    Image.fromarray(random.integers(256, size=(900, 1200, 3), dtype=np.uint8)).save(tmp_path / "one.jpg")
    figures = {}
    for place in ("memory", "files"):
        done = subprocess.run(
            [sys.executable, "-c", MEASURED, str(tmp_path), place],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        figures[place] = json.loads(done.stdout)
    (held, size, total), (taken, filed, same) = figures["memory"], figures["files"]
    assert size == filed == 60 * 3 * 1200 * 900
    assert total == same
    assert held > 0.9 * size
    assert taken < 0.2 * size  # eight photos that are read ahead

"""A capture that asks for the example becomes photos of the still life, once; other captures are read as they are.

Not proved here: what is trained on the photos, which are like those of any capture.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from splatmill.schema import EXAMPLE_FILE
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.archives import unpacked_room
from splatmill_worker.images.prepare import prepare
from splatmill_worker.pipeline import example

SIZE = (96, 72)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("PHOTOS", 4), ("WIDTH", SIZE[0]), ("HEIGHT", SIZE[1])):
        monkeypatch.setattr(example, name, value)


def asking(folder: Path) -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "images" / EXAMPLE_FILE).write_text("Still life\n")
    return folder


def test_the_example_becomes_photos_that_are_made_once(tmp_path: Path) -> None:
    capture, work = asking(tmp_path / "capture"), tmp_path / "work"
    reported: list[tuple[str, int, int]] = []
    claimed: list[tuple[str, int]] = []

    def read() -> Path:
        with unpacked_room.claimed_by(lambda name, size, may_refuse: claimed.append((name, size))):
            return example.photographed_capture(
                capture,
                work,
                lambda stage, done, total, note: reported.append((stage, done, total)),
                lambda: False,
            )

    made = read()
    prepared = prepare(made / "images", None, tmp_path / "prepared")
    assert [photo.name for photo in prepared.photos] == [f"still_{number:04d}.jpg" for number in range(1, 5)]
    assert not prepared.skipped
    with Image.open(made / "images" / "still_0001.jpg") as photo:
        assert photo.size == SIZE
    assert sorted(reported) == [("images", number, 4) for number in range(1, 5)]
    times = {path: path.stat().st_mtime_ns for path in (made / "images").iterdir()}
    assert read() == made
    assert {path: path.stat().st_mtime_ns for path in (made / "images").iterdir()} == times
    stored = sum(path.stat().st_size for path in (made / "images").iterdir())
    assert all(name == "example" and size >= stored for name, size in claimed)


def test_a_photo_of_the_default_size_fits_the_room_that_is_claimed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(example, "PHOTOS", 2)
    made = example.photographed_capture(
        asking(tmp_path / "capture"), tmp_path / "work", lambda *_: None, lambda: False
    )
    assert max(path.stat().st_size for path in (made / "images").iterdir()) < example.MOST_BYTES / 30


def test_making_the_photos_is_cancelled_and_begun_again(tmp_path: Path) -> None:
    capture, work = asking(tmp_path / "capture"), tmp_path / "work"
    begun: list[int] = []
    with pytest.raises(Cancelled):
        example.photographed_capture(
            capture, work, lambda stage, done, total, note: begun.append(done), lambda: len(begun) >= 2
        )
    made = example.photographed_capture(capture, work, lambda *_: None, lambda: False)
    assert len(list((made / "images").iterdir())) == 4


@pytest.mark.parametrize("beside", ["images/photo.jpg", "poses/transforms.json"])
def test_files_of_ones_own_are_not_replaced(tmp_path: Path, beside: str) -> None:
    capture = asking(tmp_path / "capture")
    (capture / beside).parent.mkdir(exist_ok=True)
    (capture / beside).write_bytes(b"x")
    assert example.photographed_capture(capture, tmp_path / "work", lambda *_: None, lambda: False) == capture

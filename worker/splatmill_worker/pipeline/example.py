"""The example scene: a capture that asks for photos of the built-in still life in place of bringing any."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path

from splatmill.schema import EXAMPLE_FILE
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.archives import unpacked_room
from splatmill_worker.images.prepare import filled_once, given_files
from splatmill_worker.synthetic import capture as photographed

PHOTOS = 30
WIDTH, HEIGHT = 640, 480
"""Pixels of a photo."""

MOST_BYTES = PHOTOS * 200_000
"""Bytes of the photos, at most."""

OnProgress = Callable[[str, int, int, str], None]


def photographed_capture(
    capture: Path,
    workdir: Path,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Path:
    """Return the folder to read a capture from: one with photos of the still life if it is the example, else `capture`.

    A capture is the example if EXAMPLE_FILE is its only file. The photos are the same each time.

    on_progress: called as ("images", photos that were begun, photos in all, name of the photo).
    cancelled: polled before each photo; when it returns true, Cancelled is raised.
    """
    names = [path.relative_to(capture).as_posix() for path in given_files(capture)]
    if names != [f"images/{EXAMPLE_FILE}"]:
        return capture
    number = count(1)

    def begin(name: str) -> None:
        if cancelled():
            raise Cancelled("Making the photos of the example was cancelled.")
        on_progress("images", next(number), PHOTOS, name)

    folder = workdir / "unpacked" / "example"
    unpacked_room.take(folder.name, MOST_BYTES)
    return filled_once(
        folder, lambda place: photographed(place / "images", PHOTOS, WIDTH, HEIGHT, begin=begin)
    )

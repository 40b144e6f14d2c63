"""The video of a fit: the picture as it emerges."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from torch import Tensor

from splatmill.files import replacing
from splatmill_worker.film import Film, with_even_sides
from splatmill_worker.splat.picture import as_image
from splatmill_worker.splat.views import TrainingView

INTERVALS = 120
TAKEN_AT = tuple((i / INTERVALS) ** 2 for i in range(INTERVALS))
"""Shares of the budget at which frames are taken: dense at the beginning, where the picture changes most."""

FPS = 24

LAST_FRAMES = 24
"""Repetitions of the last frame, one second."""


class FitVideo:
    """Writes renderings to a video file as they come; until the first one, its last frame is white."""

    def __init__(self, film: Film, width: int, height: int) -> None:
        self._film = film
        self._last = np.full((height, width, 3), 255, np.uint8)

    @staticmethod
    @contextmanager
    def writing(path: Path, view: TrainingView) -> Iterator[FitVideo]:
        """Open a video of the size of `view`. The file appears when the block ends without an error."""
        height, width = with_even_sides(view.full.rgb.numpy()).shape[:2]
        with replacing(path) as part, Film(part, width, height, FPS) as film:
            yield FitVideo(film, width, height)

    def add(self, color: Tensor) -> None:
        """Append a rendering [H, W, 3]."""
        self._last = with_even_sides(np.asarray(as_image(color)))
        self._film.add(self._last)

    def hold(self) -> None:
        """Repeat the last frame for a second."""
        for _ in range(LAST_FRAMES):
            self._film.add(self._last)

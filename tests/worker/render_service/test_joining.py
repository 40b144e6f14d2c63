"""Proves that the parts of a video, joined, are the frames of one written at once, each at its time.

Not proved here: that players other than FFmpeg play it.
"""

from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest

from splatmill_worker.film import Film
from splatmill_worker.render_service.joining import join


def _frame(number: int) -> npt.NDArray[np.uint8]:
    """A picture with its number as its brightness."""
    return np.full((48, 64, 3), 4 * number, np.uint8)


def _film(path: Path, numbers: range, fps: int = 24, width: int = 64) -> Path:
    with Film(path, width, 48, fps) as film:
        for number in numbers:
            film.add(_frame(number)[:, :width])
    return path


def _shown(path: Path) -> list[tuple[Fraction, int]]:
    """When each frame is shown, in seconds, and its number."""
    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        return [
            (frame.pts * stream.time_base, round(frame.to_ndarray(format="rgb24").mean() / 4))
            for frame in container.decode(stream)
        ]


@pytest.mark.parametrize("fps", [1, 7, 24, 60])
def test_each_frame_is_shown_once_at_its_time(tmp_path: Path, fps: int) -> None:
    # With B-frames, without them, and a part of a single frame, which is decoded without delay.
    ends = [0, 24, 25, 33, 35, 50]
    parts = [_film(tmp_path / f"{start}.mp4", range(start, end), fps) for start, end in pairwise(ends)]
    assert join(parts, tmp_path / "joined.mp4") == 50
    assert _shown(tmp_path / "joined.mp4") == [(Fraction(number, fps), number) for number in range(50)]
    _film(tmp_path / "whole.mp4", range(50), fps)
    for name in ("joined.mp4", "whole.mp4"):
        with av.open(str(tmp_path / name)) as container:
            stream: Any = container.streams.video[0]
            assert (stream.frames, stream.average_rate) == (50, fps), name
            # The file states its length in milliseconds.
            assert abs(stream.duration * stream.time_base - Fraction(50, fps)) < Fraction(1, 1000), name


def test_parts_that_do_not_fit_together_are_refused(tmp_path: Path) -> None:
    parts = [_film(tmp_path / "0.mp4", range(3)), _film(tmp_path / "3.mp4", range(3, 6), width=32)]
    with pytest.raises(ValueError, match=r"3\.mp4 was encoded with other settings"):
        join(parts, tmp_path / "joined.mp4")

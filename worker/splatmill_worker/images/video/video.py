"""Takes frames of a video for structure from motion: sharp ones, spaced by how far the image moves and not by time.

A video has many frames where the camera went slowly, and equal ones where it stood. Frames that are spaced by image
motion show the scene from as many sides with fewer photos, and leave no hole where the camera went fast (decisions:
keyframes).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from PIL import Image

from splatmill_worker.errors import Cancelled, UnusableVideo
from splatmill_worker.images import guarded
from splatmill_worker.images.flow import Grey, displacement
from splatmill_worker.images.video import video_frame
from splatmill_worker.images.video.video_times import Passed
from splatmill_worker.wording import plain

SHARPNESS_SIDE = 480
"""Pixels of the longest side of the reduced frame on which sharpness is measured."""

MOTION_SIDE = 96
"""Pixels of the longest side of the reduced frame on which motion is measured."""

CANDIDATES = 4
"""Frames that are looked at for each that is taken: the sharpest of as many intervals of equal length."""

STILL = 0.01
"""Least length of a stretch of motion, as a share of the longer side, as long as there are FEWEST of them or more."""

FEWEST = 30
"""Least number of stretches that the motion is divided into, however small it is, as before a turntable. A stretch
without a candidate gives no frame."""

QUALITY = 95
"""JPEG quality of the frames."""

MAX_WRITTEN_BYTES = 16 * 2**30
"""Bytes of all frames of a video as JPEGs: some formats draw noise that takes no bytes in the video."""


class Candidate(NamedTuple):
    """A frame that may be taken.

    number: its position in the video, from 0.
    sharpness: as `sharpness` says.
    moved: by how much the picture moved since the candidate before, as a share of the longer side.
    """

    number: int
    sharpness: float
    moved: float


def keyframes(
    path: Path, count: int, cancelled: Callable[[], bool] = lambda: False
) -> Iterator[tuple[int, bytes]]:
    """Yield the numbers and the JPEGs of at most `count` frames of the video at `path`, in order.

    They are sRGB, upright, and have square pixels. Of a video with a damaged end, the frames before the damage are
    used. The video is decoded twice: to choose the frames, and to encode them.

    Raises UnusableVideo when the file has no video that decodes or exceeds a limit, and Cancelled.
    """
    if count < 1:
        raise ValueError(f"{count} frames were asked for; ask for at least 1.")
    numbers = chosen(_candidates(path, CANDIDATES * count, cancelled), count)
    done = size = 0
    with _decoded(path, cancelled) as (aspect, frames):
        for number, frame in frames:
            if number == numbers[done]:
                picture = _jpeg(video_frame.picture(frame, aspect), video_frame.panorama_xmp(frame))
                size += len(picture)
                if size > MAX_WRITTEN_BYTES:
                    raise UnusableVideo(
                        path.name,
                        f"its frames have more than {MAX_WRITTEN_BYTES} bytes as JPEGs; take fewer or smaller frames",
                    )
                yield number, picture
                done += 1
                if done == len(numbers):
                    break


def remarks(path: Path) -> list[str]:
    """What is assumed or converted in the video at `path`, as sentences with {} for its name.

    Raises UnusableVideo as `keyframes` does.
    """
    with _decoded(path, lambda: False) as (aspect, frames):
        for _, frame in frames:
            return video_frame.remarks(frame, aspect)
    return []


def _jpeg(image: Image.Image, xmp: bytes) -> bytes:
    picture = io.BytesIO()
    image.save(picture, "JPEG", quality=QUALITY, subsampling=0, xmp=xmp)
    return picture.getvalue()


def chosen(candidates: Sequence[Candidate], count: int) -> list[int]:
    """The numbers of at most `count` frames, in order: the sharpest of each of as many stretches of equal motion."""
    path = np.cumsum([candidate.moved for candidate in candidates])
    stretches = min(count, max(min(count, FEWEST), int(path[-1] / STILL)))
    # A thousandth more, so that the last candidate does not begin a stretch of its own.
    of = np.floor(path / max(path[-1] * 1.001 / stretches, 1e-12)).astype(int)
    best: dict[int, Candidate] = {}
    for stretch, candidate in zip(of.tolist(), candidates, strict=True):
        if stretch not in best or candidate.sharpness > best[stretch].sharpness:
            best[stretch] = candidate
    return [candidate.number for candidate in best.values()]


def sharpness(grey: Grey) -> float:
    """The variance of the Laplacian of a grey image [H,W]; motion blur and defocus lower it."""
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4.0 * grey[1:-1, 1:-1]
    return float(laplacian.var()) if laplacian.size else 0.0


def _candidates(path: Path, count: int, cancelled: Callable[[], bool]) -> list[Candidate]:
    """The sharpest frame of each of `count` intervals, with its motion. Raises UnusableVideo where there is none.

    The motion to a frame of another size, as when a phone is turned while it records, is not known and counts as none.
    """
    candidates: list[Candidate] = []
    last: Grey | None = None
    for number, score, small in _sharpest(path, count, cancelled):
        moved = displacement(last, small) if last is not None and last.shape == small.shape else 0.0
        candidates.append(Candidate(number, score, moved))
        last = small
    if not candidates:
        raise UnusableVideo(path.name, "it contains no frame")
    return candidates


def _sharpest(path: Path, count: int, cancelled: Callable[[], bool]) -> Iterator[tuple[int, float, Grey]]:
    """Number, sharpness and small picture of the sharpest frame of each of `count` intervals of equal length; intervals
    without a frame are skipped."""
    best: tuple[int, float, Grey] | None = None
    interval = 0
    passed = Passed.of(path, cancelled)
    with _decoded(path, cancelled) as (aspect, frames):
        for number, frame in frames:
            at = min(count - 1, max(interval, int(passed.share(frame.pts, number) * count)))
            if at != interval and best is not None:
                yield best
                best = None
            interval = at
            score = sharpness(video_frame.grey(frame, aspect, SHARPNESS_SIDE))
            if best is None or score > best[1]:
                best = number, score, video_frame.grey(frame, aspect, MOTION_SIDE)
    if best is not None:
        yield best


@contextmanager
def _decoded(
    path: Path, cancelled: Callable[[], bool]
) -> Iterator[tuple[Fraction | None, Iterator[tuple[int, av.VideoFrame]]]]:
    """The width of a pixel over its height, and the frames with their numbers, up to where the video is damaged.

    Raises UnusableVideo where no frame decodes or a limit is exceeded, and Cancelled.
    """
    count = 0

    def frames() -> Iterator[tuple[int, av.VideoFrame]]:
        nonlocal count
        for number, frame in enumerate(guarded.frames(path.name, container, stream)):
            if cancelled():
                raise Cancelled("Reading the video was cancelled.")
            count = number + 1
            yield number, frame

    try:
        with guarded.opened_video(path) as (container, stream):
            yield stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio, frames()
    except av.FFmpegError as error:
        if not count:
            raise UnusableVideo(path.name, f"it does not decode as video ({plain(error)})") from error

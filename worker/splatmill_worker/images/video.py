"""Takes frames of a video for structure from motion: sharp ones, spaced by how far the image moves and not by time.

A video has many frames where the camera went slowly, and equal ones where it stood. Frames that are spaced by image
motion show the scene from as many sides with fewer photos, and leave no hole where the camera went fast (decisions:
keyframes).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.errors import Cancelled, UnusableVideo
from splatmill_worker.images import guarded
from splatmill_worker.images.flow import Grey, displacement

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

DEFAULT_RATE = 30.0
"""Frames per second assumed for videos without time stamps."""


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

    The rotation in the video is applied. Of a video with a damaged end, the frames before the damage are used. The
    video is decoded twice: to choose the frames, and to encode them.

    Raises UnusableVideo when the file has no video that decodes or exceeds a limit, and Cancelled.
    """
    if count < 1:
        raise ValueError(f"{count} frames were asked for; ask for at least 1.")
    numbers = chosen(_candidates(path, CANDIDATES * count, cancelled), count)
    done = size = 0
    with _decoded(path, cancelled) as (_, frames):
        for number, frame in frames:
            if number == numbers[done]:
                picture = _jpeg(frame)
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
    found: list[Candidate] = []
    last: Grey | None = None
    for number, score, small in _sharpest(path, count, cancelled):
        moved = displacement(last, small) if last is not None and last.shape == small.shape else 0.0
        found.append(Candidate(number, score, moved))
        last = small
    if not found:
        raise UnusableVideo(path.name, "it contains no frame")
    return found


def _sharpest(path: Path, count: int, cancelled: Callable[[], bool]) -> Iterator[tuple[int, float, Grey]]:
    """Number, sharpness and small picture of the sharpest frame of each of `count` intervals of equal length; intervals
    without a frame are skipped."""
    best: tuple[int, float, Grey] | None = None
    interval = 0
    with _decoded(path, cancelled) as (length, frames):
        for number, frame in frames:
            time = frame.time if frame.time is not None else number / DEFAULT_RATE
            at = min(count - 1, max(interval, int(time / length * count)))
            if at != interval and best is not None:
                yield best
                best = None
            interval = at
            score = sharpness(_grey(frame, SHARPNESS_SIDE))
            if best is None or score > best[1]:
                best = number, score, _grey(frame, MOTION_SIDE)
    if best is not None:
        yield best


@contextmanager
def _decoded(
    path: Path, cancelled: Callable[[], bool]
) -> Iterator[tuple[float, Iterator[tuple[int, av.VideoFrame]]]]:
    """The length of the video in seconds, and its frames with their numbers, up to where it is damaged.

    Raises UnusableVideo where no frame decodes or a limit is exceeded, and Cancelled.
    """
    seen = 0

    def frames() -> Iterator[tuple[int, av.VideoFrame]]:
        nonlocal seen
        for number, frame in enumerate(guarded.frames(path.name, container, stream)):
            if cancelled():
                raise Cancelled("Reading the video was cancelled.")
            seen = number + 1
            yield number, frame

    try:
        with guarded.opened_video(path) as (container, stream):
            length = _duration(path, container, stream)
            guarded.check_length(path.name, length)
            yield length, frames()
    except av.FFmpegError as error:
        if not seen:
            raise UnusableVideo(path.name, f"it does not decode as video ({error})") from error


def _duration(path: Path, container: av.container.InputContainer, stream: av.VideoStream) -> float:
    """The video's length in seconds: that of the stream, of the container, by the number of frames, or as measured."""
    if stream.duration and stream.time_base:
        return max(float(stream.duration * stream.time_base), 1e-3)
    if container.duration:
        return max(container.duration / av.time_base, 1e-3)
    rate = float(stream.average_rate) if stream.average_rate else DEFAULT_RATE
    return max(stream.frames / rate or _measured(path, rate), 1e-3)


def _measured(path: Path, rate: float) -> float:
    """The length by the last time stamp, or by the number of packets at `rate`: browsers record without a length."""
    last = 0.0
    with guarded.opened_video(path) as (container, stream):
        for number, packet in enumerate(container.demux(stream)):
            end = (
                packet.pts * packet.time_base
                if packet.pts is not None and packet.time_base
                else number / rate
            )
            last = max(last, float(end))
            guarded.check_length(path.name, last)
    return last + 1.0 / rate


def _grey(frame: av.VideoFrame, side: int) -> Grey:
    """The frame in grey [H,W], reduced to a longest side of `side` pixels."""
    factor = min(1.0, side / max(frame.width, frame.height))
    width, height = max(3, int(frame.width * factor)), max(3, int(frame.height * factor))
    small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    grey: npt.NDArray[np.float32] = small.to_ndarray().astype(np.float32)
    return grey


def _jpeg(frame: av.VideoFrame) -> bytes:
    """A frame, upright."""
    image: Image.Image = frame.to_image()  # type: ignore[no-untyped-call]  # PyAV leaves it untyped
    turn = {
        90: Image.Transpose.ROTATE_90,
        180: Image.Transpose.ROTATE_180,
        270: Image.Transpose.ROTATE_270,
    }.get(round(frame.rotation) % 360)
    if turn is not None:
        image = image.transpose(turn)
    picture = io.BytesIO()
    image.save(picture, "JPEG", quality=QUALITY, subsampling=0)
    return picture.getvalue()

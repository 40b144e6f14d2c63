"""Takes the sharpest frames of a video, one from each of several intervals of equal length."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.errors import Cancelled, UnusableVideo
from splatmill_worker.images import guarded

SHARPNESS_SIDE = 480
"""Pixels of the longest side of the reduced frame on which sharpness is measured."""

QUALITY = 95
"""JPEG quality of the frames."""

DEFAULT_RATE = 30.0
"""Frames per second assumed for videos without time stamps."""


def sharpest_frames(
    path: Path,
    target: Path,
    count: int,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Write `count` frames of the video at `path` as JPEGs in `target`, and return their paths in order.

    The frame with the largest variance of its Laplacian is taken from each of `count` intervals of equal length; a
    video with fewer frames gives all of them. The files are called <stem>_<frame number>.jpg. The rotation in the video
    is applied. Of a video with a damaged end, the frames before the damage are used.

    Raises UnusableVideo when the file has no video that decodes or exceeds a limit, and Cancelled.
    """
    if count < 1:
        raise ValueError(f"{count} frames were asked for; ask for at least 1.")
    target.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    try:
        with guarded.opened_video(path) as (container, stream):
            length = _duration(path, container, stream)
            guarded.check_length(path.name, length)
            best: tuple[float, av.VideoFrame, int] | None = None
            interval = 0
            for number, frame in enumerate(guarded.frames(path.name, container, stream)):
                if cancelled():
                    raise Cancelled("Reading the video was cancelled.")
                time = frame.time if frame.time is not None else number / DEFAULT_RATE
                at = min(count - 1, max(interval, int(time / length * count)))
                if at != interval and best is not None:
                    written.append(_save(best, target, path.stem))
                    on_progress(len(written), count)
                    best = None
                interval = at
                score = sharpness(_grey(frame))
                if best is None or score > best[0]:
                    best = score, frame, number
            if best is not None:
                written.append(_save(best, target, path.stem))
    except av.FFmpegError as error:
        if not written:
            raise UnusableVideo(path.name, f"it does not decode as video ({error})") from error
    if not written:
        raise UnusableVideo(path.name, "it contains no frame")
    return written


def sharpness(grey: npt.NDArray[np.float32]) -> float:
    """The variance of the Laplacian of a grey image [H,W]; motion blur and defocus lower it."""
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4.0 * grey[1:-1, 1:-1]
    return float(laplacian.var()) if laplacian.size else 0.0


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


def _grey(frame: av.VideoFrame) -> npt.NDArray[np.float32]:
    """The frame in grey [H,W], reduced to SHARPNESS_SIDE."""
    factor = min(1.0, SHARPNESS_SIDE / max(frame.width, frame.height))
    width, height = max(3, int(frame.width * factor)), max(3, int(frame.height * factor))
    return frame.reformat(width=width, height=height, format="gray").to_ndarray().astype(np.float32)


def _save(best: tuple[float, av.VideoFrame, int], target: Path, stem: str) -> Path:
    """Write the frame of (sharpness, frame, number), upright."""
    _, frame, number = best
    image: Image.Image = frame.to_image()  # type: ignore[no-untyped-call]  # PyAV leaves it untyped
    turn = {
        90: Image.Transpose.ROTATE_90,
        180: Image.Transpose.ROTATE_180,
        270: Image.Transpose.ROTATE_270,
    }.get(round(frame.rotation) % 360)
    if turn is not None:
        image = image.transpose(turn)
    place = target / f"{stem}_{number:06d}.jpg"
    image.save(place, quality=QUALITY, subsampling=0)
    return place

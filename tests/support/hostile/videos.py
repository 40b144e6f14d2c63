"""Videos that are cut off, have no length, or are something else."""

from __future__ import annotations

import io
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import numpy as np

from tests.support.hostile.pictures import noise

PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nfile:///etc/passwd\n#EXTINF:10,\nhttp://127.0.0.1:1/a.ts\n"
CONCAT = b"ffconcat version 1.0\nfile /etc/hostname\nfile http://127.0.0.1:1/a.mp4\n"


def video(
    form: str = "mp4",
    *,
    frames: int = 12,
    codec: str = "libx264",
    stamps: Callable[[int], int] | None = None,
    **options: str,
) -> bytes:
    """A video of noise, 64 x 48 pixels; `stamps` are tenths of seconds by the number of the frame."""
    data = io.BytesIO()
    with av.open(data, "w", format=form, options=options) as container:
        stream: Any = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(frames):
            picture = np.asarray(noise(seed=number).resize((64, 48)))
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            if stamps is not None:
                frame.pts, frame.time_base = stamps(number), Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return data.getvalue()


def without_length() -> bytes:
    """A WebM as a browser records it: neither a length nor a number of frames."""
    return video("webm", codec="libvpx", live="1")


def larger_than_8k() -> bytes:
    """A video of one frame of 8,208 x 4,336 pixels."""
    data = io.BytesIO()
    with av.open(data, "w", format="avi") as container:
        stream: Any = container.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = 8_208, 4_336, "yuvj420p"
        frame = av.VideoFrame(8_208, 4_336, "yuvj420p")
        for plane in frame.planes:
            plane.update(bytes(plane.buffer_size))
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return data.getvalue()

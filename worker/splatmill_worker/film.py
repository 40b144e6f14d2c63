"""Writes videos frame by frame: MP4 with H.264 and 4:2:0 chroma, which browsers and phones play."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np
import numpy.typing as npt

MIN_SIDE = 16
"""Pixels of a frame's side, at least: the side of an H.264 macroblock; players refuse smaller videos."""

CRF = 20
"""Constant rate factor of x264, 0 (lossless) to 51."""


class Film:
    """A video being written to `path`.

    width, height: size of the frames in pixels, both even.
    fps: frames per second.

    As a context manager it is closed at the end of the block. Raises av.FFmpegError, OSError or ValueError when the
    video cannot be written; write to a path of `splatmill.files.replacing` to leave no incomplete file behind.
    """

    def __init__(self, path: Path, width: int, height: int, fps: int) -> None:
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream: Any = self._container.add_stream("libx264", rate=fps)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": str(CRF), "preset": "veryfast"}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        # The file is incomplete in any case; the error of the block must not be hidden by one of closing.
        with suppress(av.FFmpegError, OSError, ValueError):
            self._container.close()

    def add(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Append a frame, RGB [H, W, 3]."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        """Write the frames that the encoder still holds, and the index."""
        try:
            for packet in self._stream.encode():
                self._container.mux(packet)
        finally:
            self._container.close()


def with_even_sides(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The image [H, W, 3] at a size that a video can have.

    Images smaller than MIN_SIDE are enlarged by a whole factor, and the last row or column of an odd side is repeated.
    """
    factor = -(-MIN_SIDE // min(pixels.shape[:2]))
    if factor > 1:
        pixels = pixels.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

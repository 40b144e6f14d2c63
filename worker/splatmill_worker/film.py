"""Videos written picture by picture: MP4 (H.264, 4:2:0), which every browser and phone plays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np
import numpy.typing as npt

SMALLEST = 16  # pixels of a side; H.264 works in blocks of this size, and players refuse less


class Film:
    """A video under way at `path`, `width` x `height` pixels (both even), `fps` pictures a second; `close` it."""

    def __init__(self, path: Path, width: int, height: int, fps: int) -> None:
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream: Any = self._container.add_stream("libx264", rate=fps)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "20", "preset": "veryfast"}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        # What lies there is not whole in any case, and the error under way is the one to tell.
        with suppress(av.FFmpegError, OSError, ValueError):
            self._container.close()

    def add(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Append a picture, RGB [H, W, 3]."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        """Write what the encoder still holds, and the index."""
        try:
            for packet in self._stream.encode():
                self._container.mux(packet)
        finally:
            self._container.close()


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write the file `path`: it takes its name when the block ends, and vanishes when the block fails."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def even(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """A picture [H, W, 3] as a video can hold it: tiny ones enlarged, odd sides repeated at the end."""
    factor = -(-SMALLEST // min(pixels.shape[:2]))
    if factor > 1:
        pixels = pixels.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

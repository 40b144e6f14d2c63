"""When the frames of a video are shown, by their stamps."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from splatmill_worker.errors import Cancelled
from splatmill_worker.images import guarded

LONGEST_PAUSE = 1.0
"""Seconds between two frames beyond which time says nothing of how far the camera went: a recording that was paused,
single frames of a time-lapse, or stamps that jump."""

DEFAULT_RATE = 30.0
"""Frames per second of videos that name no rate, as far as their length is concerned."""


@dataclass(frozen=True)
class Passed:
    """The time that has passed at each frame that is shown, from the first one on.

    stamps: of the frames, in order, in ticks; empty where the file has none.
    shares: of the whole time, 0 to 1.
    frames: number of frames.

    A pause of more than LONGEST_PAUSE counts as that long. Lengths that a file declares are not read: they may count
    from another beginning than the stamps, or be missing.
    """

    stamps: npt.NDArray[np.int64]
    shares: npt.NDArray[np.float64]
    frames: int

    @staticmethod
    def of(path: Path, cancelled: Callable[[], bool]) -> Passed:
        """Of the video at `path`, of which nothing is decoded. Raises UnusableVideo for one that is too long."""
        stamps, packets, tick, rate = set[int](), 0, 0.0, DEFAULT_RATE
        with guarded.opened_video(path) as (container, stream), suppress(av.FFmpegError):
            rate = float(stream.average_rate or DEFAULT_RATE)
            for packet in container.demux(stream):
                if cancelled():
                    raise Cancelled("Reading the video was cancelled.")
                # AVI has a constant rate and no stamps, for which FFmpeg counts packets in the order of decoding.
                stamp = None if container.format.name == "avi" else packet.pts
                # Those before the beginning of an edit list are decoded and not shown.
                if packet.size and not packet.is_discard:
                    packets += 1
                    if stamp is not None:
                        stamps.add(stamp)
                        tick = float(packet.time_base or 0)
                guarded.check_frames(path.name, packets)
        ordered = np.array(sorted(stamps), np.int64)
        passed = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(ordered) * tick, LONGEST_PAUSE))])
        guarded.check_length(path.name, float(passed[-1]) or packets / rate)
        # The last frame is shown as long as the others, on average.
        return Passed(ordered, passed / max(passed[-1] * (1 + 1 / max(len(ordered) - 1, 1)), 1e-12), packets)

    def share(self, stamp: int | None, number: int) -> float:
        """The share of the time that has passed at a frame, by its stamp if it has one, or else by its number."""
        if stamp is None or len(self.stamps) < 2:
            return number / max(self.frames, 1)
        place = int(np.searchsorted(self.stamps, stamp))
        return float(self.shares[min(place, len(self.shares) - 1)])

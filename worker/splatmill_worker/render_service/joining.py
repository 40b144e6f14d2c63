"""Makes one video of parts that `Film` has written, without encoding any frame anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av

from splatmill_worker.images import guarded

MAX_REORDERED = 2
"""Frames by which decoding precedes showing, at most: what x264 reorders with up to three B-frames and a pyramid."""


def join(parts: Sequence[Path], path: Path) -> int:
    """Write the frames of videos of one `Film` each, one after the other, as one video, and return their number.

    The parts must have the same size, speed and settings of the encoder. Raises ValueError where they differ,
    UnusableVideo for a part that cannot be read, and av.FFmpegError or OSError.
    """
    frames = written = 0
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as target:
        stream: Any = None
        for part in parts:
            with guarded.opened_video(part) as (source, opened):
                track: Any = opened
                if stream is None:
                    stream = target.add_stream_from_template(track)
                elif track.codec_context.extradata != stream.codec_context.extradata:
                    raise ValueError(
                        f"the part {part.name} was encoded with other settings than those before it"
                    )
                # The duration of a frame in units of the time base.
                frame = int(1 / (track.average_rate * track.time_base))
                for packet in source.demux(track):
                    if packet.dts is None:  # the end of the part
                        continue
                    packet.pts += frames * frame
                    # Counted anew: a part of a single frame is decoded without the delay of those with B-frames.
                    packet.dts = (written - MAX_REORDERED) * frame
                    packet.stream = stream
                    target.mux(packet)
                    written += 1
                frames += track.frames
    return frames

"""What can be asked of structure from motion; `auto` is decided from the photos and from what was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True)
class SfmOptions:
    """`side`, `features`: longest side in pixels and features per photo; None leaves them to the effort.

    `frames`: how many frames are taken from a video. `camera_model`: COLMAP's name. `stereo`: look for more points
    where there are few. `threads` None: all cores.
    """

    effort: Literal["auto", "lean", "standard", "high"] = "auto"
    matcher: Literal["auto", "exhaustive", "sequential", "spatial"] = "auto"
    mapper: Literal["auto", "incremental", "global"] = "auto"
    side: int | None = None
    features: int | None = None
    camera_model: str = "auto"
    frames: int = 150
    stereo: bool = True
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True)
class Effort:
    """How hard the photos are looked at.

    `side` pixels; at most `features` a photo; `first_octave` -1 doubles the photo first (four times the time,
    three times the features); `orientations` a feature may have; each photo is matched with `partners` others.
    """

    name: str
    side: int
    features: int
    first_octave: int
    orientations: int
    partners: int


LEAN = Effort("lean", 800, 1500, 0, 1, 10)
STANDARD = Effort("standard", 800, 2500, -1, 1, 10)
HIGH = Effort("high", 1400, 6000, -1, 2, 16)
EFFORTS = {effort.name: effort for effort in (LEAN, STANDARD, HIGH)}
# Photos this small give too few features at their own size and cost little at twice it.
SMALL_SIDE = 700


def fitted(effort: Effort, longest_side: int) -> Effort:
    """The effort for photos with this longest side, in pixels."""
    small = effort.first_octave == 0 and min(effort.side, longest_side) <= SMALL_SIDE
    return replace(effort, first_octave=-1) if small else effort

"""Options of structure from motion, and the three efforts that `auto` chooses from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class SfmOptions:
    """Options of structure from motion; `auto` is decided from the photos and their matches.

    effort: how thoroughly features are searched for and matched; `auto` starts lean, or with the
        standard effort where photos are few, and raises it where needed.
    matcher: how pairs of photos are chosen.
    mapper: which of COLMAP's mappers estimates the poses.
    side: longest side of the photos that features are found on, in pixels; None: by the effort.
    features: features per photo, at most; None: by the effort.
    camera_model: COLMAP's name of the lens model.
    frames: number of frames taken from a video.
    stereo: whether stereo adds points where there are few.
    seed: of every random choice.
    threads: CPU threads; None: one per core.
    seconds: time for the cameras, None without a limit: no effort is tried after one that has placed half of the photos
        if it would take longer. Not in the `repr`, by which results are kept.
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
    seconds: float | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Effort:
    """How thoroughly features are searched for and matched.

    name: stable name.
    side: longest side of the photos that features are found on, in pixels.
    features: features per photo, at most.
    partners: number of other photos that each photo is matched with.
    """

    name: str
    side: int
    features: int
    partners: int


# Larger photos and more features, step by step (decisions: sift).
LEAN = Effort("lean", side=640, features=1000, partners=10)
STANDARD = Effort("standard", side=800, features=2500, partners=10)
HIGH = Effort("high", side=1400, features=6000, partners=16)

EFFORTS = {effort.name: effort for effort in (LEAN, STANDARD, HIGH)}

NEXT_EFFORT = 3.0
"""Longest time of an effort over that of all before it, rounded (decisions: FEW_PHOTOS)."""

FISHEYE = "SIMPLE_RADIAL_FISHEYE"
"""COLMAP's camera model by which photos of a fisheye lens are mapped."""

PANORAMA_SIDE = 3.0
"""Longest side of a panorama that features are found on, over that of other photos: its pixels are then of the size of
those of a photo that shows 120 degrees across."""

PANORAMA_FEATURES = 4
"""Features of a panorama, over those of other photos: it shows as much as several of them."""

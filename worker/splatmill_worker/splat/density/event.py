"""What a densification is told about the run, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Moment:
    """Where the run stands. `allowed` is the most Gaussians there may be after this event."""

    step: int
    progress: float
    extent: float
    allowed: int


@dataclass(frozen=True)
class Change:
    """How many Gaussians an event added and removed."""

    added: int = 0
    removed: int = 0

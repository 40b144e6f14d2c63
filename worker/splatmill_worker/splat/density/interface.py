"""What every densification strategy is asked, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from splatmill_worker.kernels.records import Scores
from splatmill_worker.splat.engine import Engine


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


class Densifier(Protocol):
    """One strategy."""

    @property
    def scores(self) -> Scores | None:
        """Which of the engine's scores it reads."""

    def densify(self, engine: Engine, moment: Moment, random: torch.Generator) -> Change:
        """Add, move and remove Gaussians; called between steps, at the times that the schedule sets."""

    def after_step(self, engine: Engine, position_rate: float, random: torch.Generator) -> None:
        """Called after every step with the position rate used in it."""

"""How long a run may take: steps, or training seconds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from splatmill.schema.quantities import parse_duration

_STEPS = re.compile(r"(\d+)\s*steps?")


@dataclass(frozen=True)
class Budget:
    """A budget of training steps or of seconds; the other field is None."""

    steps: int | None
    seconds: float | None

    @property
    def name(self) -> str:
        """The name in rows and tables: `600steps` or `60s`."""
        return f"{self.steps}steps" if self.steps is not None else f"{self.seconds:g}s"

    @property
    def options(self) -> dict[str, Any]:
        """The fields of TrainOptions that set this budget."""
        return {"steps": self.steps} if self.steps is not None else {"time_budget": self.seconds}


def parse(text: str) -> Budget:
    """`600steps`, `10s`, `2m`, `90`. Raises ValueError, as a sentence, for anything else."""
    steps = _STEPS.fullmatch(text.strip().lower())
    if steps is not None:
        if int(steps[1]) < 1:
            raise ValueError("A budget of 0 steps trains nothing; give at least 1step.")
        return Budget(int(steps[1]), None)
    try:
        seconds = float(parse_duration(text))
    except ValueError as error:
        raise ValueError(f"{text!r} is no budget; write steps (600steps) or a time (10s, 2m).") from error
    if not seconds >= 1.0:
        raise ValueError(f"A budget of {text!r} is too short; the least is 1s.")
    return Budget(None, seconds)

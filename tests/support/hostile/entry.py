"""One row of the list of hostile inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.support.hostile.bench import Answer, Bench


@dataclass(frozen=True)
class Hostile:
    """An input, and the answer that it must get.

    area: heading under which it is listed.
    what: the input in words.
    give: gives it to the real part.
    kind: the expected `Answer.kind`.
    said: a part of the expected `Answer.said`.
    """

    area: str
    what: str
    give: Callable[[Bench], Answer]
    kind: str
    said: str = ""

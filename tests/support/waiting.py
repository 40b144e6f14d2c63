"""Waiting for what other processes do, without sleeping for luck."""

import time
from collections.abc import Callable
from typing import Literal, TypeVar

from splatmill.process import start_time

Value = TypeVar("Value")

SHORTEST_PAUSE, LONGEST_PAUSE = 0.01, 0.25
"""Seconds between two looks. Most conditions ask a server, which requests every 10 ms keep busy; so the pause grows to
a tenth of the time that was waited already."""


def wait_for(condition: Callable[[], Value | Literal[False] | None], seconds: float = 120.0) -> Value:
    """Return the first true value of `condition`. Fails the test when there is none within `seconds`."""
    began = time.monotonic()
    while True:
        if value := condition():
            return value
        waited = time.monotonic() - began
        assert waited < seconds, f"nothing after {seconds} s"
        time.sleep(min(max(SHORTEST_PAUSE, 0.1 * waited), LONGEST_PAUSE))


def gone(pids: list[int]) -> bool:
    """Whether none of these processes runs any more."""
    return all(start_time(pid) is None for pid in pids)

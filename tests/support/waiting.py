"""Waiting for what other processes do, without sleeping for luck."""

import time
from collections.abc import Callable
from typing import Literal, TypeVar

from splatmill.backplane.process import start_time

Value = TypeVar("Value")


def wait_for(condition: Callable[[], Value | Literal[False] | None], seconds: float = 30.0) -> Value:
    """Return the first true value of `condition`. Fails the test when there is none within `seconds`."""
    end = time.monotonic() + seconds
    while True:
        if value := condition():
            return value
        assert time.monotonic() < end, f"nothing after {seconds} s"
        time.sleep(0.01)


def gone(pids: list[int]) -> bool:
    """Whether none of these processes runs any more."""
    return all(start_time(pid) is None for pid in pids)

"""How long an attempt waits for a Redis that cannot be reached or refuses commands."""

import os
import time
from collections.abc import Callable
from typing import TypeVar

import redis

PATIENCE = float(os.environ.get("SPLATMILL_REDIS_PATIENCE") or 600.0)
"""Seconds. An attempt computes on without Redis for as long as it has work. Where it needs Redis, at its start and its
end, it waits this long. Then its process ends; the job continues from its last checkpoint when Redis works again."""

RETRY_SECONDS = 0.5

T = TypeVar("T")


def patiently(action: Callable[[], T]) -> T:
    """Return the result of `action`, repeated while Redis fails. Raises its redis.RedisError after PATIENCE."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return action()
        except redis.RedisError:
            if time.monotonic() > deadline:
                raise
            time.sleep(RETRY_SECONDS)

"""The memory of Redis: how much of its limit is used, and what happens at the limit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import redis

from splatmill.schema import format_bytes

ALARM = 0.9
"""Share of its limit from which Redis counts as nearly full."""


@dataclass(frozen=True)
class RedisMemory:
    """The memory of Redis.

    used: bytes of its data and buffers.
    limit: bytes at which it takes no more writes (`maxmemory`), or None if there is no limit.
    policy: what it does at the limit (`maxmemory-policy`).
    """

    used: int
    limit: int | None
    policy: str

    @property
    def full(self) -> bool:
        """Whether Redis refuses writes."""
        return self.limit is not None and self.used >= self.limit

    def trouble(self) -> tuple[str, str] | None:
        """Return what is wrong and what to do, a sentence each, or None."""
        if self.policy != "noeviction":
            return (
                f"When its memory is full, Redis deletes data, and jobs with it (maxmemory-policy {self.policy}).",
                "Set maxmemory-policy to noeviction.",
            )
        if self.limit is not None and self.used >= ALARM * self.limit:
            return (
                f"Redis uses {format_bytes(self.used)} of the {format_bytes(self.limit)} that it may (maxmemory).",
                "Delete jobs that are not needed, or raise maxmemory: when it is full, it takes no jobs.",
            )
        return None


def read(connection: redis.Redis) -> RedisMemory:
    """Return the memory of Redis. Raises redis.RedisError."""
    return of(connection.info("memory"))


def of(info: Mapping[str, Any]) -> RedisMemory:
    """Return the memory of Redis from its answer to `INFO memory`."""
    limit = int(info.get("maxmemory", 0)) or None
    return RedisMemory(int(info["used_memory"]), limit, str(info.get("maxmemory_policy", "noeviction")))

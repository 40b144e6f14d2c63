"""The lock on a job, which keeps two processes from working on it at the same time.

The queue may give a job to two workers: after a machine was suspended, or after Redis restarted from its log. The lock
records the process that holds it. If that process runs on this machine, a new attempt begins at once when it is dead,
and not before. A process on another machine counts as dead when its last heartbeat is too old.

An attempt that has lost the lock may still write events. Its number is lower than that of the new attempt, so that
`fold` ignores them.
"""

import json
from dataclasses import dataclass
from enum import Enum
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.queue.entries import HEARTBEAT_SLACK, MONITORING_INTERVAL
from splatmill.process import ProcessIdentity

STALE_MS = (MONITORING_INTERVAL + HEARTBEAT_SLACK) * 1000
"""Age in milliseconds of the last heartbeat at which a holder on another machine counts as dead, as it does for RQ."""

_TAKE = """
if (redis.call('HGET', KEYS[1], 'token') or '') ~= ARGV[1] then return 0 end
local now = redis.call('TIME')
redis.call('DEL', KEYS[1])
redis.call('HSET', KEYS[1], 'token', ARGV[2], 'holder', ARGV[3], 'attempt', ARGV[4],
           'seen', now[1] * 1000 + math.floor(now[2] / 1000))
return 1
"""

_REFRESH = """
local token = redis.call('HGET', KEYS[1], 'token')
if not token then return -1 end
if token ~= ARGV[1] then return 0 end
local now = redis.call('TIME')
redis.call('HSET', KEYS[1], 'seen', now[1] * 1000 + math.floor(now[2] / 1000))
return 1
"""

_RELEASE = (
    "if redis.call('HGET', KEYS[1], 'token') == ARGV[1] then return redis.call('DEL', KEYS[1]) end return 0"
)


class LockState(Enum):
    """State of the lock for the owner of a token.

    held: the lock is held under this token.
    lost: it is held under another token.
    absent: nobody holds it.
    """

    held = 1
    lost = 0
    absent = -1


@dataclass(frozen=True)
class Holder:
    """The holder of a lock.

    token: the token that it took the lock with.
    process: the process of the attempt.
    attempt: number of the attempt, 0 until it is counted.
    age_ms: milliseconds since the last heartbeat.
    """

    token: str
    process: ProcessIdentity
    attempt: int
    age_ms: int

    def gone(self) -> bool:
        """Return whether the process is dead, or on another machine and without a heartbeat for STALE_MS."""
        if self.process.visible():
            return self.process.dead()
        return self.age_ms > STALE_MS


class JobLock:
    """The lock on one job, as the owner of `token` uses it. An attempt and its parent process share a token."""

    def __init__(self, connection: redis.Redis, job_id: str, token: str) -> None:
        self._connection = connection
        self._key = keys.lock(job_id)
        self.token = token

    def holder(self) -> Holder | None:
        """Return the present holder, or None when the lock is free."""
        fields = cast(dict[bytes, bytes], self._connection.hgetall(self._key))
        if not fields:
            return None
        seconds, micros = self._connection.time()
        return Holder(
            token=fields[b"token"].decode(),
            process=ProcessIdentity.load(json.loads(fields[b"holder"])),
            attempt=int(fields[b"attempt"]),
            age_ms=seconds * 1000 + micros // 1000 - int(fields[b"seen"]),
        )

    def take(self, process: ProcessIdentity, attempt: int) -> bool:
        """Take the lock for `process` if it is free, its holder is gone, or our token holds it. Return success."""
        holder = self.holder()
        if holder is not None and holder.token != self.token and not holder.gone():
            return False
        expected = holder.token if holder else ""
        taken = self._run(_TAKE, expected, self.token, json.dumps(process.dump()), str(attempt))
        return taken == 1

    def refresh(self) -> LockState:
        """Record a heartbeat if the lock is held under our token, and return its state."""
        return LockState(self._run(_REFRESH, self.token))

    def release(self) -> None:
        """Release the lock if it is held under our token."""
        self._run(_RELEASE, self.token)

    def _run(self, script: str, *args: str) -> int:
        return int(cast(Any, self._connection.eval(script, 1, self._key, *args)))

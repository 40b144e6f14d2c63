"""The lock on a job: at most one process works on it, whatever the queue says.

The queue may hand a job out twice (a laptop that slept, a Redis that came back from its log). The lock names its
holder as a process, so that the next attempt need not wait for a time-out when that process is provably dead,
and never begins while it is provably alive. Only a holder that cannot be seen from here is judged by the age of
its last sign. An attempt that lost the lock is fenced: its number is lower than the new one's, and the fold
ignores what it still says.
"""

import json
from dataclasses import dataclass
from enum import Enum
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.process import ProcessIdentity
from splatmill.backplane.queue import HEARTBEAT_SLACK, MONITORING_INTERVAL

STALE_MS = (MONITORING_INTERVAL + HEARTBEAT_SLACK) * 1000
"""Age of the last sign after which a holder on another machine counts as gone: RQ's own patience."""

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


class Held(Enum):
    """What a look at the lock shows to the one that holds a token: still its own, no lock there, or another's."""

    own = 1
    absent = -1
    lost = 0


@dataclass(frozen=True)
class Holder:
    """Who holds a lock: its token, the process, the attempt's number and the age of the last sign in ms."""

    token: str
    process: ProcessIdentity
    attempt: int
    age_ms: int

    def gone(self) -> bool:
        """Whether another may take over: the process is provably dead, or out of sight and silent for too long."""
        if self.process.visible():
            return self.process.dead()
        return self.age_ms > STALE_MS


class JobLock:
    """The lock on one job as one attempt sees it. `token` is known to the attempt and to its parent process."""

    def __init__(self, connection: redis.Redis, job_id: str, token: str) -> None:
        self._connection = connection
        self._key = keys.lock(job_id)
        self.token = token

    def holder(self) -> Holder | None:
        """Who holds the lock now, if anybody."""
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
        """Take the lock for `process` if it is free, its holder is gone, or it is ours already."""
        holder = self.holder()
        if holder is not None and holder.token != self.token and not holder.gone():
            return False
        expected = holder.token if holder else ""
        taken = self._run(_TAKE, expected, self.token, json.dumps(process.dump()), str(attempt))
        return taken == 1

    def refresh(self) -> Held:
        """Give a sign of life for the holder."""
        return Held(self._run(_REFRESH, self.token))

    def release(self) -> None:
        """Give the lock up; nothing happens when it is not ours."""
        self._run(_RELEASE, self.token)

    def _run(self, script: str, *args: str) -> int:
        return int(cast(Any, self._connection.eval(script, 1, self._key, *args)))

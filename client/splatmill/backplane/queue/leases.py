"""Leases: until when a worker holds an entry of the queue that it has taken, by the clock of Redis alone.

The leases are the members of RQ's sorted set of started entries, `<entry>:<execution>`, scored by the time at which
they expire. A lease begins when `lines.take` takes the entry. RQ itself takes the times from the clock of whichever
machine calls it, so that two clocks that differ by more than a heartbeat would requeue an attempt that runs. Every time
here is that of Redis, read in the same step.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import redis

from splatmill.backplane import keys, totals
from splatmill.backplane.queue import rq_keys
from splatmill.backplane.queue.entries import (
    HEARTBEAT_SLACK,
    KEEP_FINISHED,
    MONITORING_INTERVAL,
    split_rq_id,
)

LEASE = MONITORING_INTERVAL + HEARTBEAT_SLACK
"""Seconds for which a heartbeat holds an entry."""

MAX_LOST = 6
"""Number of attempts in a row that may end with their worker and without a new checkpoint. Then the job fails, because
it probably ends the worker itself, by taking all memory of its machine."""

Requeued = Literal["waiting", "failed", "absent", "kept"]
"""What became of an entry whose worker was lost. `waiting`: it is in the queue again. `failed`: it has been lost
MAX_LOST times. `absent`: it was deleted. `kept`: its lease was prolonged or given up meanwhile."""

_PROLONG = """
if not redis.call('ZSCORE', KEYS[1], ARGV[1]) then return 0 end
redis.call('ZADD', KEYS[1], tonumber(redis.call('TIME')[1]) + ARGV[2], ARGV[1])
if redis.call('EXISTS', KEYS[2]) == 1 then redis.call('EXPIRE', KEYS[2], ARGV[2]) end
return 1
"""

_IS_HELD = """
local function held(leases, entry)
  for _, member in ipairs(redis.call('ZRANGE', leases, 0, -1)) do
    if string.sub(member, 1, #entry + 1) == entry .. ':' then return true end
  end
  return false
end
"""

# KEYS: leases, RQ's record of the execution, RQ's record of the entry, places of the entries that wait.
# ARGV: member, seconds of the lease, entry, execution, worker, then fields and values of the entry's record.
_REJOIN = (
    _IS_HELD
    + """
if redis.call('ZSCORE', KEYS[1], ARGV[1]) then return 1 end
if redis.call('HEXISTS', KEYS[4], ARGV[3]) == 1 or held(KEYS[1], ARGV[3]) then return 0 end
local known = redis.call('HMGET', KEYS[3], 'status', 'worker_name')
local own = known[1] == 'started' and known[2] == ARGV[5]  -- the attempt began after the loss, and RQ recorded that
if redis.call('EXISTS', KEYS[3]) == 1 and not own then return 0 end
local now = tonumber(redis.call('TIME')[1])
for index = 6, #ARGV, 2 do redis.call('HSET', KEYS[3], ARGV[index], ARGV[index + 1]) end
redis.call('HSET', KEYS[3], 'status', 'started', 'worker_name', ARGV[5])
redis.call('HSET', KEYS[2], 'id', ARGV[4], 'created_at', now, 'last_heartbeat', now, 'worker_name', ARGV[5])
redis.call('EXPIRE', KEYS[2], ARGV[2])
redis.call('ZADD', KEYS[1], now + ARGV[2], ARGV[1])
return 1
"""
)

# KEYS: leases, RQ's record of the entry. ARGV: entry.
_DROP_UNHELD = (
    _IS_HELD
    + """
if redis.call('HGET', KEYS[2], 'status') ~= 'started' or held(KEYS[1], ARGV[1]) then return 0 end
return redis.call('DEL', KEYS[2])
"""
)

# KEYS: leases. ARGV: seconds of a lease. One that would last longer was made before the clock of Redis was set back.
_EXPIRED = """
local now = tonumber(redis.call('TIME')[1])
local last = now + ARGV[1]
for _, member in ipairs(redis.call('ZRANGEBYSCORE', KEYS[1], '(' .. last, '+inf')) do
  redis.call('ZADD', KEYS[1], last, member)
end
return redis.call('ZRANGEBYSCORE', KEYS[1], '-inf', now)
"""

# KEYS: leases, RQ's records of the entry and of the execution, queue, totals. ARGV: member, entry, whether only if
# expired, limit, seconds to keep, name of the total.
_REQUEUE = """
local expires = redis.call('ZSCORE', KEYS[1], ARGV[1])
if not expires then return 'kept' end
if ARGV[3] == '1' and tonumber(expires) > tonumber(redis.call('TIME')[1]) then return 'kept' end
redis.call('ZREM', KEYS[1], ARGV[1])
redis.call('DEL', KEYS[3])
if redis.call('EXISTS', KEYS[2]) == 0 then return 'absent' end
local lost = redis.call('HINCRBY', KEYS[2], 'splatmill_lost', 1)
if lost >= tonumber(ARGV[4]) then
  redis.call('HSET', KEYS[2], 'status', 'failed')
  redis.call('EXPIRE', KEYS[2], ARGV[5])
  redis.call('HINCRBY', KEYS[5], ARGV[6] .. '|failed', 1)
  return 'failed'
end
redis.call('HSET', KEYS[2], 'status', 'queued', 'worker_name', '')
if lost == 1 then redis.call('HSET', KEYS[2], 'splatmill_front', 1) end
redis.call('RPUSH', KEYS[4], ARGV[2])
redis.call('HINCRBY', KEYS[5], ARGV[6] .. '|waiting', 1)
return 'waiting'
"""

log = logging.getLogger("splatmill.queue")


@dataclass(frozen=True)
class Lease:
    """The lease of one execution of an entry."""

    entry: str
    execution: str

    @property
    def member(self) -> str:
        return f"{self.entry}:{self.execution}"


def prolong(connection: redis.Redis, lease: Lease) -> bool:
    """Prolong a lease by a heartbeat. Return False if it is not held any more: another worker may run the entry."""
    execution = rq_keys.execution(lease.member)
    return bool(connection.eval(_PROLONG, 2, rq_keys.STARTED, execution, lease.member, LEASE))


def rejoin(connection: redis.Redis, lease: Lease, worker: str, record: Mapping[Any, Any]) -> bool:
    """Take a lease again that is not held any more because Redis has lost its data. Return whether it is held.

    worker: the name of the worker that runs the entry.
    record: RQ's record of the entry, as the worker knows it.

    It is not taken again while another execution holds one, nor where Redis knows the entry as anything else than
    started by this worker: as waiting, for example.
    """
    fields = [part for field in record.items() for part in field]
    execution, entry = rq_keys.execution(lease.member), rq_keys.record(lease.entry)
    arguments = lease.member, LEASE, lease.entry, lease.execution, worker, *fields
    return bool(connection.eval(_REJOIN, 4, rq_keys.STARTED, execution, entry, keys.PLACES, *arguments))


def advanced(connection: redis.Redis, entry: str) -> None:
    """Record that an attempt has stored a new checkpoint: workers that were lost before it do not count any more."""
    connection.hdel(rq_keys.record(entry), "splatmill_lost")


def to_the_front(connection: redis.Redis, entry: str) -> None:
    """Have an entry come in front of its owner's others when it next waits."""
    connection.hset(rq_keys.record(entry), "splatmill_front", 1)


def lost(connection: redis.Redis, entry: str) -> int:
    """Return how many attempts in a row have ended with their worker and without a new checkpoint."""
    return int(cast(Any, connection.hget(rq_keys.record(entry), "splatmill_lost")) or 0)


def drop(connection: redis.Redis, lease: Lease) -> None:
    """Delete a lease and RQ's record of its entry, which cannot be read. The reaper enqueues its job anew."""
    with connection.pipeline() as pipe:
        pipe.delete(rq_keys.record(lease.entry))
        pipe.zrem(rq_keys.STARTED, lease.member)
        pipe.execute()


def drop_unheld(connection: redis.Redis, entry: str) -> bool:
    """Delete RQ's record of an entry that is marked as started and that no worker holds a lease on.

    Return whether it was deleted. The reaper then enqueues its job anew.
    """
    return bool(connection.eval(_DROP_UNHELD, 2, rq_keys.STARTED, rq_keys.record(entry), entry))


def held(connection: redis.Redis) -> list[Lease]:
    """Return all leases, also the expired ones. A member of another form is removed and logged."""
    return _leases(connection, cast(list[bytes], connection.zrange(rq_keys.STARTED, 0, -1)))


def owners(connection: redis.Redis, held_leases: Sequence[Lease]) -> list[str | None]:
    """Return the name of the worker that holds each of these leases; None where its record has expired."""
    with connection.pipeline(transaction=False) as pipe:
        for lease in held_leases:
            pipe.hget(rq_keys.execution(lease.member), "worker_name")
        return [name.decode() if name is not None else None for name in pipe.execute()]


def running(connection: redis.Redis) -> dict[str, float]:
    """Return, by name of worker, for how many seconds the attempts that are leased have run."""
    with connection.pipeline(transaction=False) as pipe:
        for lease in held(connection):
            pipe.hmget(rq_keys.execution(lease.member), "worker_name", "created_at")
        replies = cast(list[list[bytes | None]], pipe.execute())
    now = connection.time()[0]
    return {worker.decode(): max(0.0, now - float(since)) for worker, since in replies if worker and since}


def requeue(connection: redis.Redis, lease: Lease, *, if_expired: bool) -> Requeued:
    """Put an entry whose worker was lost into the queue, or fail it after MAX_LOST times, in one step.

    It comes in front of its owner's others. One whose worker was lost before, without a new checkpoint since, comes
    behind them: it may be what ends the worker.
    """
    answer = connection.eval(
        _REQUEUE,
        5,
        rq_keys.STARTED,
        rq_keys.record(lease.entry),
        rq_keys.execution(lease.member),
        rq_keys.ARRIVALS,
        keys.TOTALS,
        lease.member,
        lease.entry,
        int(if_expired),
        MAX_LOST,
        KEEP_FINISHED,
        totals.WORKERS_LOST.name,
    )
    return cast(Requeued, cast(bytes, answer).decode())


class Reclaim:
    """Requeues the entries whose leases have expired, as one process that watches them does.

    Nothing is requeued for LEASE seconds after Redis was away, as far as this process can tell: it started anew, did
    not answer, answered late, refused writes, was replaced, or its clock jumped (a suspended machine). The workers
    could not prolong their leases then, and get the time for it.
    """

    def __init__(self, connection: redis.Redis) -> None:
        self._connection = connection
        self._troubled_at = float("-inf")
        self._run_id: object = None
        self._offset: float | None = None

    def run(self) -> list[tuple[Lease, Requeued]]:
        """Requeue what has expired, and return what became of each. Raises redis.RedisError."""
        if not self._trusted():
            return []
        members = cast(list[bytes], self._connection.eval(_EXPIRED, 1, rq_keys.STARTED, LEASE))
        reclaimed: list[tuple[Lease, Requeued]] = []
        for lease in _leases(self._connection, members):
            became = requeue(self._connection, lease, if_expired=True)
            if became != "kept":
                log.warning("the worker of %s was lost; the entry is now %s", lease.entry, became)
                reclaimed.append((lease, became))
        return reclaimed

    def _trusted(self) -> bool:
        """Return whether Redis has been there for so long that every living worker has prolonged its lease."""
        asked = time.monotonic()
        try:
            # A Redis that refuses writes also refuses heartbeats.
            self._connection.set(keys.WRITABLE, 1, ex=LEASE)
            info = self._connection.info("server")
            seconds, micros = self._connection.time()
        except redis.RedisError:
            self._troubled_at = time.monotonic()
            raise
        answered = time.monotonic()
        offset = seconds + micros / 1e6 - answered
        jumped = self._offset is not None and abs(offset - self._offset) > MONITORING_INTERVAL
        replaced = self._run_id is not None and info["run_id"] != self._run_id
        if jumped or replaced or answered - asked > MONITORING_INTERVAL:
            self._troubled_at = answered
        self._run_id, self._offset = info["run_id"], offset
        return answered - self._troubled_at >= LEASE and int(info["uptime_in_seconds"]) >= LEASE


def _leases(connection: redis.Redis, members: list[bytes]) -> list[Lease]:
    readable = []
    for member in members:
        entry, _, execution = member.decode("utf-8", "replace").rpartition(":")
        try:
            split_rq_id(entry)
        except ValueError:
            if connection.zrem(rq_keys.STARTED, member):
                log.warning(
                    "removed %r from the leases, because it is not '<job>-<generation>:<execution>'", member
                )
        else:
            readable.append(Lease(entry, execution))
    return readable

"""Room that is reserved in an owner's quota before anything is stored for it, by the server and by workers, in Redis.

A reservation is an entry of `keys.uploads(owner)`. It is made, or grows, by one script that compares the sum with the
limit, so that of many at once only those are admitted that fit. It ends as an entry with the bytes that were really
stored, which the next scan of storage counts and removes. The entry's name says how long it lives without that:

    arriving/{token}            until nobody has renewed it for UPLOAD_SECONDS
    job/{job}                   as long as the job is unfinished: what its attempts store
    work/{job}                  until the job is deleted: what they unpack and leave on the worker's disk
    stored/{record}/{listing}   bytes that were stored, until a later listing of storage counts them

Files of a job that a scan has counted already are not counted again in the job's reservation.
"""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, cast

import redis

from splatmill.backplane import keys

UPLOAD_SECONDS = 3600.0
"""Seconds after its last sign of life at which an upload counts as broken off."""

ARRIVING, JOB, WORK, STORED = "arriving", "job", "work", "stored"

EVERYBODY = ""
"""Field of the hash of limits whose limit holds for owners that have none of their own. No owner has an empty name."""

NOTED: Final = "noted"
"""In place of a limit: the one that was last noted for the owner, or else that of EVERYBODY."""

_SUM = """
local function held(id)
  local size = 0
  for _, kind in ipairs({'job', 'model'}) do
    local ok, entry = pcall(cjson.decode, redis.call('hget', KEYS[3], kind .. '/' .. id) or '')
    if ok and type(entry) == 'table' then
      size = size + (tonumber(entry.bytes) or 0) + (tonumber(entry.derived) or 0)
    end
  end
  return size
end
local function size_of(field, value)
  local size = tonumber(value)
  if not size then
    local ok, entry = pcall(cjson.decode, value)
    size = ok and type(entry) == 'table' and tonumber(entry.bytes) or 0
  end
  local job = string.match(field, '^job/(.+)$')
  return job and math.max(0, size - held(job)) or size
end
local function sum(except)
  local total = tonumber(redis.call('hget', KEYS[2], ARGV[1]) or '0')
  local entries = redis.call('hgetall', KEYS[1])
  for i = 1, #entries, 2 do
    if entries[i] ~= except then total = total + size_of(entries[i], entries[i + 1]) end
  end
  return total
end
"""

_USED = _SUM + "return sum('')"

# ARGV: owner, field, limit ('' for none), bytes, folder, time, whether the bytes come beyond what a scan has counted of
# the job. Never makes an entry smaller.
_RESERVE = (
    _SUM
    + """
local size, limit = tonumber(ARGV[4]), tonumber(ARGV[3])
if ARGV[3] == 'noted' then
  limit = tonumber(redis.call('hget', KEYS[4], ARGV[1]) or redis.call('hget', KEYS[4], '') or '')
end
if ARGV[7] == 'beyond' then size = size + held(ARGV[5]) end
local known, before = redis.call('hget', KEYS[1], ARGV[2]), -1
if known then
  local ok, entry = pcall(cjson.decode, known)
  before = ok and type(entry) == 'table' and tonumber(entry.bytes) or -1
end
if size > before then
  local used = sum(ARGV[2])
  local entry = cjson.encode({bytes = size})
  if limit and used + size_of(ARGV[2], entry) > limit then return {0, used, limit} end
else
  size = before
end
redis.call('hset', KEYS[1], ARGV[2],
  string.format('{"bytes":%.0f,"capture":%s,"touched":%s}', size, cjson.encode(ARGV[5]), ARGV[6]))
redis.call('hincrby', KEYS[2], ARGV[1], 0)
return {1, 0, 0}
"""
)

# ARGV: owner, field, bytes stored, folder. KEYS[4]: the scan.
_SETTLE = (
    _SUM
    + """
redis.call('hdel', KEYS[1], ARGV[2])
local stored = tonumber(ARGV[3])
if string.match(ARGV[2], '^job/') then stored = math.max(0, stored - held(ARGV[4])) end
if stored > 0 then
  local listing = redis.call('hget', KEYS[4], 'listing') or '0'
  redis.call('hincrby', KEYS[1], 'stored/' .. ARGV[4] .. '/' .. listing, string.format('%.0f', stored))
  redis.call('hincrby', KEYS[2], ARGV[1], 0)
end
"""
)


class NoRoom(Exception):
    """A reservation does not fit into the quota.

    used: bytes in storage and reserved by others.
    limit: of the owner.
    size: of the refused reservation.
    """

    def __init__(self, owner: str, used: int, limit: int, size: int) -> None:
        super().__init__(f"{owner}: {used} bytes of {limit} are used, and {size} are needed")
        self.owner, self.used, self.limit, self.size = owner, used, limit, size


def reserve(
    connection: redis.Redis,
    owner: str,
    field: str,
    size: int,
    *,
    folder: str,
    limit: int | str | None = NOTED,
    beyond: bool = False,
    now: float | None = None,
) -> None:
    """Make a reservation of `size` bytes, or let one grow to that size; either way, renew it. Raises NoRoom.

    folder: id of the capture, job or model that the bytes are for.
    limit: bytes that the owner may have; None for any number.
    beyond: for a job, whether the bytes come on top of what a scan has counted of it and of its model.
    """
    if now is None:
        now = float(cast(Any, connection.time())[0])
    arguments = (
        owner,
        field,
        "" if limit is None else limit,
        size,
        folder,
        repr(now),
        "beyond" if beyond else "",
    )
    fits, used, bound = cast(
        list[int],
        connection.eval(
            _RESERVE, 4, *_names(owner), keys.STORED_LIMITS, *(str(value) for value in arguments)
        ),
    )
    if not fits:
        raise NoRoom(owner, used, bound, size)


def settle(connection: redis.Redis, owner: str, field: str, *, folder: str, stored: int) -> None:
    """End a reservation, of whose bytes `stored` are in storage now."""
    connection.eval(_SETTLE, 4, *_names(owner), keys.SCAN, owner, field, str(stored), folder)


def used(connection: redis.Redis, owner: str) -> int:
    """Return the bytes that an owner has in storage and has reserved."""
    return cast(int, connection.eval(_USED, 3, *_names(owner), owner))


def job(job_id: str) -> str:
    """Return the name of the reservation for what a job stores."""
    return f"{JOB}/{job_id}"


def work(job_id: str) -> str:
    """Return the name of the reservation for what a job unpacks on the disk of its worker."""
    return f"{WORK}/{job_id}"


@contextmanager
def reserved(connection: redis.Redis, owner: str, size: int, *, folder: str) -> Iterator[None]:
    """Reserve room for `size` bytes that are stored while the context is open. Raises NoRoom."""
    field = f"{ARRIVING}/{secrets.token_hex(8)}"
    reserve(connection, owner, field, size, folder=folder)
    stored = 0
    try:
        yield
        stored = size
    finally:
        settle(connection, owner, field, folder=folder, stored=stored)


def note_limit(connection: redis.Redis, owner: str, limit: int | None) -> None:
    """Note the limit of an owner for what is stored without a caller, by workers too."""
    if limit is None:
        connection.hdel(keys.STORED_LIMITS, owner)
    else:
        connection.hset(keys.STORED_LIMITS, owner, limit)


def _names(owner: str) -> tuple[str, str, str]:
    return keys.uploads(owner), keys.STORED_TOTALS, keys.stored(owner)

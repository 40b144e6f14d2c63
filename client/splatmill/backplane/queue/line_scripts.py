"""The Lua scripts of `lines`, each of which Redis runs in one step.

Each begins by sorting what has arrived, and returns first the entries that it removed because they belong to no job.
"""

from string import Template

from splatmill.backplane import keys, totals
from splatmill.backplane.queue import rq_keys
from splatmill.schema import DEFAULT_OWNER

_BELLS = 100
"""Largest number of elements of a bell; idle workers look again after a few seconds anyway."""

_BEGIN = Template(
    """
local inbox, leases = '${inbox}', '${leases}'
local records, executions = '${records}', '${executions}'
local places, turns, counters, arrived = '${places}', '${turns}', '${counters}', '${arrived}'

local function now()
  local time = redis.call('TIME')
  return tonumber(time[1]) + tonumber(time[2]) / 1000000
end

local function line_key(line, owner) return '${line}' .. line .. ':' .. owner end

local function wanted_line(options)
  local read, chosen = pcall(cjson.decode, options or '{}')
  local backend = read and type(chosen) == 'table' and chosen.backend
  if backend == 'gpu' then return 'gpu' end
  if backend == 'cpu' or backend == 'reference' then return 'cpu' end
  return 'any'
end

-- '<job>-<generation>', or for a tile '<job>-<generation>_<tile>'
local function job_of(entry)
  return string.match(entry, '^(.+)%-%d+$$') or string.match(entry, '^(.+)%-%d+_%d+$$')
end

local function leave(entry)
  local place = redis.call('HGET', places, entry)
  if not place then return 0 end
  redis.call('HDEL', places, entry)
  redis.call('ZREM', arrived, entry)
  return redis.call('ZREM', '${line}' .. place, entry)
end

local function queue_up(entry, job, in_front)
  leave(entry)
  local row = redis.call('HMGET', '${job}' .. job, 'owner', 'priority', 'options')
  local owner, line = row[1] or '${owner}', wanted_line(row[3])
  -- The coarse model alone is trained on a GPU.
  if line == 'gpu' and string.match(entry, '_%d+$$') then line = 'any' end
  local number
  if in_front then
    number = redis.call('HINCRBY', counters, 'front', -1)
    redis.call('ZADD', turns, 0, owner)  -- its turn was interrupted, and comes again
  else number = redis.call('HINCRBY', counters, 'back', 1) end
  -- Numbers stay below 2^40, so that a priority weighs more than any of them.
  redis.call('ZADD', line_key(line, owner), number - (tonumber(row[2]) or 0) * 1099511627776, entry)
  redis.call('HSET', places, entry, line .. ':' .. owner)
  redis.call('ZADD', arrived, string.format('%.3f', now()), entry)
  redis.call('ZADD', turns, 'NX', 0, owner)
  redis.call('RPUSH', '${bell}' .. line, 1)
  redis.call('LTRIM', '${bell}' .. line, -${bells}, -1)
end

local foreign = {}
while redis.call('LLEN', inbox) > 0 do  -- a Redis that refuses writes refuses to pop from an empty list as well
  local entry = redis.call('LPOP', inbox)
  local job = job_of(entry)
  if job then queue_up(entry, job, redis.call('HDEL', records .. entry, 'splatmill_front') == 1)
  else
    redis.call('DEL', records .. entry)
    foreign[#foreign + 1] = entry
  end
end
"""
).substitute(
    inbox=rq_keys.ARRIVALS,
    leases=rq_keys.STARTED,
    records=rq_keys.RECORD,
    executions=rq_keys.EXECUTION,
    places=keys.PLACES,
    turns=keys.TURNS,
    counters=keys.COUNTERS,
    arrived=keys.ARRIVED,
    line=keys.line("", "")[:-1],
    bell=keys.bell(""),
    job=keys.job(""),
    owner=DEFAULT_OWNER,
    bells=_BELLS,
)

SORT = _BEGIN + "return {foreign}"

TAKE = (
    _BEGIN
    + totals.observing(totals.QUEUE_WAIT)
    + """
local function first(owner)
  local found, line, lowest
  for index = 4, #ARGV do
    local head = redis.call('ZRANGE', line_key(ARGV[index], owner), 0, 0, 'WITHSCORES')
    if head[1] and (not found or tonumber(head[2]) < lowest) then
      found, line, lowest = head[1], ARGV[index], tonumber(head[2])
    end
  end
  return found, line
end

for _, owner in ipairs(redis.call('ZRANGE', turns, 0, -1)) do
  local entry, line = first(owner)
  while entry do
    redis.call('ZREM', line_key(line, owner), entry)
    redis.call('HDEL', places, entry)
    local since = redis.call('ZSCORE', arrived, entry)
    redis.call('ZREM', arrived, entry)
    local record = records .. entry
    if redis.call('HGET', record, 'status') == 'queued' then
      local second = math.floor(now())
      local member = entry .. ':' .. ARGV[2]
      redis.call('ZADD', turns, redis.call('HINCRBY', counters, 'turn', 1), owner)
      redis.call('ZADD', leases, second + ARGV[3], member)
      redis.call('HSET', executions .. member, 'id', ARGV[2], 'created_at', second, 'last_heartbeat', second,
                 'worker_name', ARGV[1])
      redis.call('EXPIRE', executions .. member, ARGV[3])
      redis.call('HSET', record, 'status', 'started', 'worker_name', ARGV[1])
      if since then observe(line, now() - tonumber(since)) end
      return {foreign, entry, line}
    end
    entry, line = first(owner)  -- that one was deleted or has ended
  end
end
return {foreign}
"""
)
"""Take an entry. Arguments: worker, execution, seconds of the lease, lines that the worker serves.

Further results: the entry and its line, if there is one.
"""

WITHDRAW = (
    _BEGIN
    + """
local removed = leave(ARGV[1])
if removed == 1 and redis.call('EXISTS', records .. ARGV[1]) == 1 then
  redis.call('HSET', records .. ARGV[1], 'status', 'canceled')
  redis.call('EXPIRE', records .. ARGV[1], ARGV[2])
end
return {foreign, removed}
"""
)
"""Remove a waiting entry. Arguments: entry, seconds to keep its record. Further result: whether it waited."""

HAND_BACK = (
    _BEGIN
    + """
if redis.call('ZREM', leases, ARGV[1]) == 0 then return {foreign, 0} end
redis.call('DEL', executions .. ARGV[1])
redis.call('HSET', records .. ARGV[2], 'status', 'queued', 'worker_name', '')
queue_up(ARGV[2], job_of(ARGV[2]), true)
return {foreign, 1}
"""
)
"""End a lease and put its entry in front. Arguments: member of the leases, entry. Further result: whether it was held.
"""

LOOK = (
    _BEGIN
    + """
local lines, index, lengths, found = {}, 1, {}, {}
while ARGV[index] ~= '' do lines[index] = ARGV[index]; index = index + 1 end
for _, owner in ipairs(redis.call('ZRANGE', turns, 0, -1)) do
  local counts, total = {}, 0
  for number, line in ipairs(lines) do
    counts[number] = redis.call('ZCARD', line_key(line, owner))
    total = total + counts[number]
  end
  if total > 0 then lengths[#lengths + 1] = {owner, counts} end
end
for entry = index + 1, #ARGV do
  local place = redis.call('HGET', places, ARGV[entry])
  if place then
    local line, owner = string.match(place, '^(%a+):(.*)$')
    local score, before = redis.call('ZSCORE', line_key(line, owner), ARGV[entry]), {}
    for number, other in ipairs(lines) do
      before[number] = redis.call('ZCOUNT', line_key(other, owner), '-inf', '(' .. score)
    end
    found[#found + 1] = {ARGV[entry], line, owner, before}
  end
end
return {foreign, lengths, found}
"""
)
"""Look at what waits. Arguments: the lines, an empty one, entries.

Further results: the lengths of the lines by owner, in the order of their turns; and for each entry that waits its line,
its owner, and how many entries of its owner are before it in each line.
"""

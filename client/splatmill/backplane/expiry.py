"""Keys that expire in time also where the clock of Redis is set back.

Redis keeps the moment at which a key expires, not the time that is left: set back by an hour, a key lasts an hour more.
"""

import redis

_SHORTEN = """
local longest = tonumber(ARGV[1])
if redis.call('PTTL', KEYS[1]) > longest then redis.call('PEXPIRE', KEYS[1], longest) end
"""


def shorten(connection: redis.Redis, name: str, seconds: float) -> None:
    """Have a key that expires do so within `seconds`, the time for which it was set."""
    connection.eval(_SHORTEN, 1, name, round(1000 * seconds))

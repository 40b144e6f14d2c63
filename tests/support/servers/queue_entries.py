"""The job queue as tests look at it and play a worker at it."""

import redis

from splatmill.backplane import keys
from splatmill.backplane.queue import lines
from splatmill.backplane.queue.leases import Lease
from splatmill.backplane.queue.lines import LINES, Line


def waiting(connection: redis.Redis) -> int:
    """Return how many entries wait."""
    entries = lines.look(connection)
    counted = sum(entries.count(line) for line in LINES)
    assert counted == connection.hlen(keys.PLACES)
    return counted


def take(connection: redis.Redis, *served: Line, worker: str = "tester") -> Lease:
    """Take the next entry, as a worker that serves these lines (all by default)."""
    taken = lines.take(connection, worker, served or LINES)
    assert taken is not None, "nothing waits"
    return taken[0]

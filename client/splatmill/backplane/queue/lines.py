"""The lines in which entries of the queue wait, and which of them a worker takes next.

There is a line for what a job asks of its worker: `gpu`, `cpu`, or `any` of the two. In a line, each owner's entries
wait by priority, then in the order of arrival. The owner whose turn was longest ago is served next, with the first of
its entries that the worker can run: a thousand jobs of one owner delay another's first by one job at most. An
entry that comes back in front, because its worker stopped or was lost, gives its owner the turn back: what has begun is
finished before something else begins.

Entries arrive in RQ's list, from this version and from earlier ones, and `sort` moves them to the line that the job's
row names. All steps are single scripts. In particular an entry is taken and leased in one step: a worker that is killed
at any moment leaves it in its line or under a lease, which expires.
"""

import logging
import select
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast, get_args
from uuid import uuid4

import redis

from splatmill.backplane import keys
from splatmill.backplane.queue import line_scripts as scripts
from splatmill.backplane.queue.entries import KEEP_FINISHED
from splatmill.backplane.queue.leases import LEASE, Lease
from splatmill.backplane.refusal import refusals

Line = Literal["any", "cpu", "gpu"]
"""What a job asks of its worker, by its option `backend`. `any`: auto. `cpu`: cpu or reference. `gpu`: a usable GPU."""

LINES: tuple[Line, ...] = get_args(Line)

_KEPT_DURATIONS = 50

log = logging.getLogger("splatmill.queue")


@dataclass(frozen=True)
class Place:
    """Where an entry waits.

    line: its line.
    owner: whose job it is.
    before: number of its owner's entries before it, by line.
    """

    line: Line
    owner: str
    before: dict[Line, int]


@dataclass(frozen=True)
class Waiting:
    """What waits at one moment.

    lengths: number of waiting entries by owner and line. The owners stand in the order of their turns.
    places: the places of the entries that were asked for, without those that do not wait.
    """

    lengths: dict[str, dict[Line, int]] = field(default_factory=dict)
    places: dict[str, Place] = field(default_factory=dict)

    def count(self, line: Line) -> int:
        """Return how many entries wait in a line."""
        return sum(counts[line] for counts in self.lengths.values())

    def position(self, entry: str, served: Iterable[Line]) -> int | None:
        """Return how many entries a worker takes before this one if it serves these lines; None if it does not wait."""
        place = self.places.get(entry)
        if place is None:
            return None
        lines = set(served) | {place.line}
        own = sum(place.before[line] for line in lines)
        total, earlier = own, True
        for owner, counts in self.lengths.items():
            if owner == place.owner:
                earlier = False  # owners after this one have one turn less before the entry
            else:
                total += min(sum(counts[line] for line in lines), own + earlier)
        return total


def take(connection: redis.Redis, worker: str, served: Sequence[Line]) -> tuple[Lease, Line] | None:
    """Take the next entry for a worker that serves these lines; return its lease and its line, or None."""
    execution = uuid4().hex
    answer = _run(connection, scripts.TAKE, worker, execution, LEASE, *served)
    if len(answer) < 2:
        return None
    return Lease(answer[1].decode(), execution), cast(Line, answer[2].decode())


def wait(
    connection: redis.Redis, served: Sequence[Line], seconds: float, wake: socket.socket | None = None
) -> None:
    """Wait until an entry comes to one of these lines, at most for this time. Another worker may take it first.

    wake: a socket that ends the wait once it is readable.

    Raises redis.TimeoutError if Redis has not answered when the connection's timeout has passed after that time.
    """
    bells = [keys.bell(line) for line in served]
    if wake is None:
        connection.blpop(bells, cast(int, seconds))
        return
    pool = connection.connection_pool
    held: Any = pool.get_connection()
    try:
        held.send_command("BLPOP", *bells, seconds)
        own = held._get_socket()
        poll = select.poll()
        poll.register(own, select.POLLIN)
        poll.register(wake, select.POLLIN)
        limited = seconds and held.socket_timeout  # a wait of 0 seconds has no end
        ready = dict(poll.poll(1000 * (seconds + held.socket_timeout) if limited else None))
        if not ready:
            raise redis.TimeoutError(f"no answer to BLPOP {held.socket_timeout:g} seconds after its end")
        if own.fileno() in ready:
            with refusals():
                held.read_response()
        else:
            held.disconnect()  # the reply is still to come
    except BaseException:
        held.disconnect()
        raise
    finally:
        pool.release(held)


def sort(connection: redis.Redis) -> None:
    """Move the entries that have arrived to their lines."""
    _run(connection, scripts.SORT)


def withdraw(connection: redis.Redis, entry: str, keep: int = KEEP_FINISHED) -> bool:
    """Remove a waiting entry, as cancelled. Return False if it does not wait: a worker may just have taken it.

    keep: seconds for which RQ's record of it is kept; 0: not at all, so that it can be enqueued again.
    """
    return bool(_run(connection, scripts.WITHDRAW, entry, keep)[1])


def hand_back(connection: redis.Redis, lease: Lease) -> bool:
    """Put an entry in front of its owner's line again. Return False if the lease was not held any more."""
    return bool(_run(connection, scripts.HAND_BACK, lease.member, lease.entry)[1])


def look(connection: redis.Redis, entries: Sequence[str] = ()) -> Waiting:
    """Return what waits, with the places of these entries."""
    return _waiting(_run(connection, scripts.LOOK, *LINES, "", *entries))


def ask(pipe: Any) -> None:
    """Add the command to a pipeline whose reply `answered` reads."""
    pipe.eval(scripts.LOOK, 0, *LINES, "")


def answered(reply: list[Any]) -> Waiting:
    """Return what waits, from the reply to `ask`."""
    return _waiting(_sorted(reply))


def _waiting(answer: list[Any]) -> Waiting:
    _, lengths, places = answer
    return Waiting(
        {owner.decode(): dict(zip(LINES, counts, strict=True)) for owner, counts in lengths},
        {
            entry.decode(): Place(line.decode(), owner.decode(), dict(zip(LINES, before, strict=True)))
            for entry, line, owner, before in places
        },
    )


def record_duration(connection: redis.Redis, line: Line, seconds: float) -> None:
    """Record the seconds of an attempt that ended its job."""
    with connection.pipeline() as pipe:
        pipe.lpush(keys.durations(line), round(seconds, 1))
        pipe.ltrim(keys.durations(line), 0, _KEPT_DURATIONS - 1)
        pipe.execute()


def mean_durations(connection: redis.Redis) -> dict[Line, float]:
    """Return how many seconds the last attempts of each line took on average, for the lines that have had some."""
    with connection.pipeline(transaction=False) as pipe:
        for line in LINES:
            pipe.lrange(keys.durations(line), 0, -1)
        replies = cast(list[list[bytes]], pipe.execute())
    return {
        line: sum(map(float, kept)) / len(kept) for line, kept in zip(LINES, replies, strict=True) if kept
    }


def _run(connection: redis.Redis, script: str, *arguments: Any) -> list[Any]:
    """Run a script whose first result is the entries that it removed because they belong to no job."""
    return _sorted(cast(list[Any], connection.register_script(script)(args=arguments)))


def _sorted(answer: list[Any]) -> list[Any]:
    """Return the answer of a script, once what it removed is logged."""
    for entry in answer[0]:
        log.warning("removed the entry %r, because it is not '<job>-<generation>'", entry[:200])
    return answer

"""The lists of captures, jobs and models: sorted sets of ids by time, one for each way in which a list is asked for.

There is a list of all records of a kind and one for each owner; of jobs also one for each group (UNFINISHED, and the
final states) with and without the owner, and one for each capture. They follow from storage: `keys.LISTED` exists once
they hold all of it, and is lost with them. A list may name a record that is just being made or deleted; readers check.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, Literal, cast

import redis

from splatmill.backplane import keys
from splatmill.schema import JobState

Kind = Literal["captures", "jobs", "models"]

UNFINISHED = "unfinished"
"""The group of jobs that have not ended, as far as the server has noticed."""

GROUPS = (UNFINISHED, *(state.value for state in JobState if state.final))

VERSION = b"1"
"""Value of `keys.LISTED`. Lists of another version are made anew."""

_TIES = 16
"""Number of records that may have the same millisecond without being lost between two pages."""


class NotListed(Exception):
    """The lists do not hold all records: Redis came back empty, or another version has written them."""


def name(kind: Kind, *, owner: str | None = None, group: str | None = None) -> str:
    """Return the key of the list of a kind, of one owner and one group if they are given."""
    if kind == "jobs" and owner is None and group is None:
        return keys.JOBS
    return keys.listed(kind, group or "all", owner)


def on_capture(capture_id: str) -> str:
    """Return the key of the list of the jobs on a capture."""
    return keys.listed("jobs", f"on:{capture_id}", None)


def milliseconds(moment: datetime) -> int:
    """Return the score of a record in its lists."""
    return int(moment.timestamp() * 1000)


class Additions:
    """Records that are in no list yet, to be added together: a command for each list, and not several for each record.

    It takes the place of the pipe of `add` and `put_job`.
    """

    def __init__(self) -> None:
        self._scores: dict[str, dict[str, int]] = {}

    def zadd(self, named: str, scores: Mapping[str, int]) -> None:
        """Note additions to a list."""
        self._scores.setdefault(named, {}).update(scores)

    def zrem(self, named: str, record_id: str) -> None:
        """Do nothing: the record is in no list."""

    def send(self, pipe: Any) -> None:
        """Add what was noted, by a connection or a pipeline."""
        for named, scores in self._scores.items():
            pipe.zadd(named, scores)


def add(pipe: Any, kind: Kind, record_id: str, moment: int, owner: str) -> None:
    """Add a record to the lists of its kind, by a connection or a pipeline."""
    pipe.zadd(name(kind), {record_id: moment})
    pipe.zadd(name(kind, owner=owner), {record_id: moment})


def remove(pipe: Any, kind: Kind, record_id: str, owner: str | None) -> None:
    """Remove a record from the lists of its kind."""
    pipe.zrem(name(kind), record_id)
    if owner is not None:
        pipe.zrem(name(kind, owner=owner), record_id)


def add_model(connection: redis.Redis, model_id: str, moment: datetime, owner: str) -> None:
    """Add a model that was just stored, or stored anew. What was known of it is forgotten."""
    with connection.pipeline() as pipe:
        add(pipe, "models", model_id, milliseconds(moment), owner)
        pipe.hdel(keys.records("models"), model_id)
        pipe.execute()


def remove_model(connection: redis.Redis, model_id: str, owner: str | None) -> None:
    """Remove a model that is deleted or made anew."""
    with connection.pipeline() as pipe:
        remove(pipe, "models", model_id, owner)
        pipe.hdel(keys.records("models"), model_id)
        pipe.execute()


def put_job(pipe: Any, job_id: str, moment: int, owner: str, capture: str, group: str) -> None:
    """Put a job into its lists, and into one group alone."""
    add(pipe, "jobs", job_id, moment, owner)
    pipe.zadd(on_capture(capture), {job_id: moment})
    for other in GROUPS:
        for named in (name("jobs", group=other), name("jobs", owner=owner, group=other)):
            if other == group:
                pipe.zadd(named, {job_id: moment})
            else:
                pipe.zrem(named, job_id)


def remove_job(pipe: Any, job_id: str, owner: str | None, capture: str | None) -> None:
    """Remove a job from all its lists."""
    remove(pipe, "jobs", job_id, owner)
    if capture is not None:
        pipe.zrem(on_capture(capture), job_id)
    for group in GROUPS:
        pipe.zrem(name("jobs", group=group), job_id)
        if owner is not None:
            pipe.zrem(name("jobs", owner=owner, group=group), job_id)


def newest(
    connection: redis.Redis, names: Sequence[str], after: tuple[int, str] | None, count: int
) -> list[tuple[int, str]]:
    """Return up to `count` pairs (time in milliseconds, id) of the union of lists, newest first, in one round trip.

    after: the pair before the first one, or None.

    Raises NotListed.
    """
    top = "+inf" if after is None else str(after[0])
    with connection.pipeline(transaction=False) as pipe:
        pipe.get(keys.LISTED)
        for named in names:
            pipe.zrevrangebyscore(named, top, "-inf", start=0, num=count + _TIES, withscores=True)
        version, *replies = pipe.execute()
    if version != VERSION:
        raise NotListed
    pairs = {(int(score), member.decode()) for reply in replies for member, score in reply}
    return sorted((pair for pair in pairs if after is None or pair < after), reverse=True)[:count]


def members(connection: redis.Redis, named: str, batch: int) -> Iterator[list[str]]:
    """Yield the ids of a list in batches, oldest first. Ids that are added meanwhile come too."""
    start = 0
    while ids := cast(list[bytes], connection.zrange(named, start, start + batch - 1)):
        yield [member.decode() for member in ids]
        start += len(ids)


def clear(connection: redis.Redis, kind: Kind) -> None:
    """Delete all lists of a kind but `keys.JOBS`, which names the rows of jobs."""
    pattern = keys.listed(kind, "*", None)
    names: Iterable[Any] = connection.scan_iter(match=pattern, count=1000)
    batch = [*names, keys.records(kind)]
    connection.delete(*batch)

"""The workers that listen, as their records in Redis tell: RQ's, with the lines that each serves."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import cast

import redis

from splatmill.backplane.queue import rq_keys
from splatmill.backplane.queue.lines import LINES, Line

_LINES_FIELD = "splatmill_lines"
_SPARE_FIELD = "splatmill_spare"
_FIELDS = ("death", "state", "current_job", "last_heartbeat", _LINES_FIELD, _SPARE_FIELD)


@dataclass(frozen=True)
class WorkerRecord:
    """A worker whose last heartbeat is not too old.

    key: the key of its record.
    name: its name.
    lines: the lines that it serves; none before it has said so.
    state: idle, busy, suspended, ...
    entry: the entry that it runs.
    last_heartbeat: time of its last heartbeat by its own clock.
    spare: bytes that are free on its disk beyond its reserve; negative once the reserve is used. None before it
        has said so.
    """

    key: str
    name: str
    lines: tuple[Line, ...]
    state: str
    entry: str | None
    last_heartbeat: datetime | None
    spare: int | None = None


def served(lines: Sequence[Line]) -> dict[str, str]:
    """Return the fields of a worker's record that tell which lines it serves."""
    return {_LINES_FIELD: ",".join(lines)}


def spare(free: int) -> dict[str, str]:
    """Return the fields of a worker's record that tell what is free on its disk beyond its reserve, in bytes."""
    return {_SPARE_FIELD: str(free)}


def listening(connection: redis.Redis) -> list[WorkerRecord]:
    """Return the workers that listen or work, by name."""
    return recorded(connection, cast(set[bytes], connection.smembers(rq_keys.WORKERS)))


def recorded(connection: redis.Redis, names: Iterable[bytes]) -> list[WorkerRecord]:
    """Return those of the workers with these keys that listen or work, by name, in one round trip."""
    known = sorted(names)
    with connection.pipeline(transaction=False) as pipe:
        for worker_key in known:
            pipe.hmget(worker_key, *_FIELDS)
        replies = cast(list[list[bytes | None]], pipe.execute())
    records = zip(known, (dict(zip(_FIELDS, reply, strict=True)) for reply in replies), strict=True)
    return [
        _record(worker_key.decode(), {name: value for name, value in stored.items() if value is not None})
        for worker_key, stored in records
        if stored["death"] is None and any(value is not None for value in stored.values())
    ]


def serving(workers: Iterable[WorkerRecord], line: Line) -> list[WorkerRecord]:
    """Return those of the workers that serve a line."""
    return [worker for worker in workers if line in worker.lines]


def _record(worker_key: str, stored: dict[str, bytes]) -> WorkerRecord:
    names = stored.get(_LINES_FIELD, b"").decode().split(",")
    return WorkerRecord(
        key=worker_key,
        name=worker_key.rpartition(":")[2],
        lines=tuple(line for line in LINES if line in names),
        state=stored.get("state", b"?").decode(),
        entry=stored.get("current_job", b"").decode() or None,
        last_heartbeat=_moment(stored.get("last_heartbeat", b"").decode()),
        spare=_integer(stored.get(_SPARE_FIELD, b"").decode()),
    )


def _integer(text: str) -> int | None:
    try:
        return int(text)
    except ValueError:
        return None


def _moment(text: str) -> datetime | None:
    try:
        return datetime.fromisoformat(text).replace(tzinfo=UTC)
    except ValueError:
        return None

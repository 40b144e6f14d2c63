"""Which captures and models the jobs use, and until when, read from all rows; only unfinished jobs are folded."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.schema import DEFAULT_OWNER, StoredKind
from splatmill.schema.files.formats import is_start_file
from splatmill_server.jobs.reading import read_jobs
from splatmill_server.space.holdings import Holding

_BATCH = 500
_FIELDS = ("id", "owner", "name", "capture", "options", "created_at", "queued_at", "verdict")


@dataclass(frozen=True)
class JobUse:
    """What a job uses.

    capture, start_model: None if there is none, or if the row does not say.
    last_heard: time of its newest state, or of its creation or restart, in seconds since 1970; 0.0 if not known.
    unfinished: whether it may still run. A job whose row cannot be read counts as unfinished until it is deleted.
    readable: whether the row says what the job uses.
    """

    id: str
    owner: str
    name: str | None
    capture: str | None
    start_model: str | None
    last_heard: float
    unfinished: bool
    readable: bool

    @property
    def records(self) -> list[str]:
        """The records that the job uses, as keys of holdings."""
        used = [(StoredKind.job, self.id), (StoredKind.model, self.id)]
        used += [(StoredKind.capture, self.capture)] if self.capture else []
        used += [(StoredKind.model, self.start_model)] if self.start_model else []
        return [Holding(kind=kind, id=record_id).key for kind, record_id in used]


def all_jobs(connection: redis.Redis) -> dict[str, JobUse]:
    """Return what every job that has a row uses, by id."""
    ids = [entry.decode() for entry in cast(list[bytes], connection.zrange(keys.JOBS, 0, -1))]
    active = _active(connection)
    uses: dict[str, JobUse] = {}
    all_ids = sorted({*ids, *active})
    for start in range(0, len(all_ids), _BATCH):
        uses |= _read(connection, all_ids[start : start + _BATCH], active)
    return uses


def unfinished_jobs(connection: redis.Redis) -> list[JobUse]:
    """Return what the unfinished jobs use. A job that is created or restarted is among them at once."""
    active = _active(connection)
    return [use for use in _read(connection, sorted(active), active).values() if use.unfinished]


def _active(connection: redis.Redis) -> set[str]:
    return {entry.decode() for entry in cast(set[bytes], connection.smembers(keys.ACTIVE))}


def _read(connection: redis.Redis, job_ids: Iterable[str], active: set[str]) -> dict[str, JobUse]:
    ids = list(job_ids)
    with connection.pipeline(transaction=False) as pipe:
        for job_id in ids:
            pipe.hmget(keys.job(job_id), *_FIELDS)
            pipe.xrevrange(keys.states(job_id), count=1)
        replies = pipe.execute()
    held = read_jobs(connection, [job_id for job_id in ids if job_id in active])
    uses = {}
    for index, job_id in enumerate(ids):
        fields = dict(zip(_FIELDS, replies[2 * index], strict=True))
        if fields["id"] is not None or fields["options"] is not None:
            ended = job_id in held and held[job_id].state.final
            uses[job_id] = _use(job_id, fields, replies[2 * index + 1], job_id in active and not ended)
    return uses


def _use(job_id: str, fields: Mapping[str, bytes | None], states: Any, unfinished: bool) -> JobUse:
    texts = {name: value.decode("utf-8", "replace") for name, value in fields.items() if value is not None}
    options = _object(texts.get("options"))
    start = (options or {}).get("start")
    capture = texts.get("capture")
    moments = [_seconds(texts.get(name)) for name in ("created_at", "queued_at")]
    moments.append(_seconds((_object(texts.get("verdict")) or {}).get("at")))
    moments += [int(entry_id.partition(b"-")[0]) / 1000 for entry_id, _ in states]
    return JobUse(
        id=job_id,
        owner=texts.get("owner", DEFAULT_OWNER),
        name=texts.get("name"),
        capture=capture,
        start_model=start if isinstance(start, str) and not is_start_file(start) else None,
        last_heard=max(moments),
        unfinished=unfinished,
        readable=capture is not None and options is not None,
    )


def _object(text: str | None) -> dict[str, Any] | None:
    try:
        value = json.loads(text or "null")
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def _seconds(text: Any) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, TypeError):
        return 0.0

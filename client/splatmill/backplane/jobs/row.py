"""The job row: a Redis hash with the request and the server's decisions. Only the server writes it."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal, cast

import redis
from pydantic import BaseModel

from splatmill.backplane import keys
from splatmill.backplane.storage.records import FORMAT, UnreadableRecord, check_format, reason, warn
from splatmill.schema import DEFAULT_OWNER, Owner, Problem, Time, TrainOptions
from splatmill.schema.tolerant import keep_readable


class Verdict(BaseModel):
    """Final state of a generation, set by the server when no worker reported one.

    state: cancelled, failed if the server gave the job up, or succeeded if its model is stored and no worker said so.
    at: time of the decision.
    after: id of the last entry in the states stream at that time. Final states that a worker appends later are
        ignored, so that the end a client has seen never changes.
    problem: reason of a failure.
    """

    state: Literal["cancelled", "failed", "succeeded"]
    at: Time
    after: str = "0-0"
    problem: Problem | None = None


class JobRow(BaseModel):
    """The request for a job, and the server's decisions about it.

    `generation` grows with each restart. `queued_at`, `cancel_requested_at` and `verdict` refer to the current one.
    `format` is the version of the row's format (see `records`). `request` is the id (X-Request-ID) of the request that
    began the generation.
    """

    format: int = FORMAT
    id: str
    capture: str
    name: str | None = None
    tags: list[str] = []
    favourite: bool = False
    owner: Owner = DEFAULT_OWNER
    options: TrainOptions
    priority: int = 0
    created_at: Time
    queued_at: Time
    generation: int = 1
    cancel_requested_at: Time | None = None
    verdict: Verdict | None = None
    request: str | None = None

    def fields(self) -> dict[str, str]:
        """Return the fields of the hash: one per attribute that is not None, with models and lists as JSON."""
        plain = self.model_dump(mode="json", exclude_none=True) | {"tags": json.dumps(self.tags)}
        return {
            name: getattr(self, name).model_dump_json() if isinstance(value, dict) else str(value)
            for name, value in plain.items()
        }

    @classmethod
    def of(cls, stored: Mapping[bytes, bytes]) -> "JobRow | None":
        """Return the row in a reply to HGETALL, or None for an empty reply: there is no such hash.

        Options that this version does not know, or whose value it does not accept, are left out. Raises
        UnreadableRecord for a row that cannot be read.
        """
        if not stored:
            return None
        plain: dict[str, Any] = {
            key.decode("utf-8", "replace"): value.decode("utf-8", "replace") for key, value in stored.items()
        }
        name = f"the row of job {plain.get('id', '?')[:80]}"
        try:
            check_format(plain)
            options, left_out = keep_readable(TrainOptions.model_validate, json.loads(plain["options"]))
            plain["options"] = options
            plain["tags"] = json.loads(plain.get("tags", "[]"))
            if "verdict" in plain:
                verdict, more = keep_readable(Verdict.model_validate, json.loads(plain["verdict"]))
                plain["verdict"] = verdict
                left_out += more
            row = cls.model_validate(plain)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise UnreadableRecord(f"{name} cannot be read: {reason(error)}") from error
        if left_out:
            warn(name, f"left out what this version cannot read: {'; '.join(left_out)[:300]}")
        return row


def read(connection: redis.Redis, job_id: str) -> JobRow | None:
    """Return the row of a job, or None if Redis has none. Raises redis.RedisError if Redis cannot be reached,
    and UnreadableRecord for a row that cannot be read."""
    return JobRow.of(cast(dict[bytes, bytes], connection.hgetall(keys.job(job_id))))


def request_of(connection: redis.Redis, job_id: str) -> str | None:
    """Return the id of the request that began the job's generation, or None if it is not known."""
    request = cast(bytes | None, connection.hget(keys.job(job_id), "request"))
    return request.decode("utf-8", "replace") if request else None


def now() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)

"""The job row: a Redis hash that only the server writes. It holds what was asked for and what the server decided."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Literal, cast

import redis
from pydantic import BaseModel

from splatmill.backplane import keys
from splatmill.schema import Problem, Time, TrainOptions


class Verdict(BaseModel):
    """How the server ended a generation that no worker ended itself: cancelled, or given up as failed.

    `after` is the last entry of the states stream the server had read. A final state that a worker appends later
    comes too late and does not count, so what a client was told never changes.
    """

    state: Literal["cancelled", "failed"]
    at: Time
    after: str = "0-0"
    problem: Problem | None = None


class JobRow(BaseModel):
    """One job's request and the server's decisions about it.

    `generation` grows with each restart; `queued_at`, `cancel_requested_at` and `verdict` belong to it.
    """

    id: str
    capture: str
    name: str | None = None
    options: TrainOptions
    created_at: Time
    queued_at: Time
    generation: int = 1
    cancel_requested_at: Time | None = None
    verdict: Verdict | None = None

    def fields(self) -> dict[str, str]:
        """The hash as it is stored: one field per attribute, JSON inside, absent ones left out."""
        return {
            name: getattr(self, name).model_dump_json() if isinstance(value, dict) else str(value)
            for name, value in self.model_dump(mode="json", exclude_none=True).items()
        }

    @classmethod
    def of(cls, stored: Mapping[bytes, bytes]) -> "JobRow | None":
        """The row in a reply to HGETALL; None for an empty one, which is how Redis says there is no such hash."""
        if not stored:
            return None
        plain: dict[str, object] = {key.decode(): value.decode() for key, value in stored.items()}
        plain["options"] = TrainOptions.model_validate_json(stored[b"options"])
        if b"verdict" in stored:
            plain["verdict"] = Verdict.model_validate_json(stored[b"verdict"])
        return cls.model_validate(plain)


def read(connection: redis.Redis, job_id: str) -> JobRow | None:
    """The row of a job, or None when Redis has none. Raises redis.RedisError when Redis cannot be reached."""
    return JobRow.of(cast(dict[bytes, bytes], connection.hgetall(keys.job(job_id))))


def now() -> datetime:
    """The present, with its time zone."""
    return datetime.now(UTC)

"""The names of everything Splatmill keeps in Redis, in one place.

RQ keeps its own keys under `rq:`. Nothing here expires: a job's keys go when the job is deleted.
"""

PREFIX = "splatmill:"

JOBS = PREFIX + "jobs"
"""Sorted set of job ids, scored by creation time in milliseconds: the order of the list endpoint."""

ACTIVE = PREFIX + "active"
"""Set of ids of jobs that have not ended, as far as the server has seen: what the reaper looks at. An ended job may
still be in it; one that has not ended always is."""


def job(job_id: str) -> str:
    """Hash: the job row. Only the server writes it."""
    return f"{PREFIX}job:{job_id}"


def states(job_id: str) -> str:
    """Stream of state changes, never trimmed. Only the worker appends."""
    return f"{PREFIX}job:{job_id}:states"


def progress(job_id: str) -> str:
    """Stream of metrics, log lines and previews, trimmed. Only the worker appends."""
    return f"{PREFIX}job:{job_id}:progress"


def attempts(job_id: str) -> str:
    """Counter: how many attempts began, over all generations. Only the worker counts."""
    return f"{PREFIX}job:{job_id}:attempts"


def lock(job_id: str) -> str:
    """Hash: the process that works on a job now. Only workers write it."""
    return f"{PREFIX}job:{job_id}:lock"


def idempotency(key_digest: str) -> str:
    """String: what an `Idempotency-Key` was first used for. Holds the job id and the digest of the body."""
    return f"{PREFIX}idempotency:{key_digest}"


def of_job(job_id: str) -> tuple[str, ...]:
    """Every key that belongs to one job, for deletion."""
    return job(job_id), states(job_id), progress(job_id), attempts(job_id), lock(job_id)

"""What is deleted for its age, or because its record is missing: a pure function of a snapshot, the ages and the time.

The age of a record counts from its last use. What an unfinished job needs is never planned.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from splatmill.schema import StoredKind, format_duration
from splatmill_server.space.holdings import Holding
from splatmill_server.space.snapshot import Snapshot

Action = Literal["capture", "job", "work", "orphan"]
"""What is deleted: a capture, a job with its model, the files from which a job resumes, a folder without a record."""


@dataclass(frozen=True)
class Ages:
    """Ages at which records are deleted, in seconds; None is never.

    captures: since a file was stored or a job on the capture was last heard of.
    failed_jobs: jobs that ended without a model, since their end.
    work: files from which a job that has ended would resume.
    models: with their jobs, since the end of the job or of one that started from the model.
    orphans: folders whose record is missing, since their last write.
    """

    captures: float | None = None
    failed_jobs: float | None = None
    work: float | None = None
    models: float | None = None
    orphans: float = 86400.0


@dataclass(frozen=True)
class Planned:
    """A deletion that is due.

    held: the folder. For `job`, that of the model if there is one.
    due: when the age is reached, in seconds since 1970.
    """

    action: Action
    held: Holding
    bytes: int
    due: float
    reason: str


def plan(snapshot: Snapshot, ages: Ages, now: float) -> list[Planned]:
    """Return the deletions that are due, the oldest first."""
    due = [planned for planned in _all(snapshot, ages) if now >= planned.due]
    return sorted(due, key=lambda planned: (planned.due, planned.held.key))


def expiry(snapshot: Snapshot, ages: Ages) -> dict[str, float]:
    """Return when records are deleted for their age, in seconds since 1970, by key; the first of several ages."""
    expires: dict[str, float] = {}
    for entry in _all(snapshot, ages):
        expires[entry.held.key] = min(entry.due, expires.get(entry.held.key, entry.due))
    return expires


def _all(snapshot: Snapshot, ages: Ages) -> Iterator[Planned]:
    # A job whose row cannot be read may need any capture and any model.
    unclear = any(use.unfinished and not use.readable for use in snapshot.jobs.values())
    for held in snapshot.holdings.values():
        if held.key in snapshot.needed:
            continue
        rule = {StoredKind.capture: _capture, StoredKind.model: _model, StoredKind.job: _job}[held.kind]
        for planned in rule(snapshot, ages, held):
            if not (unclear and planned.action in ("capture", "job")):
                yield planned
    for use in snapshot.jobs.values():
        # A job that ended before it stored anything has a row alone.
        stored = Holding(kind=StoredKind.job, id=use.id, owner=use.owner, name=use.name)
        if (
            not use.unfinished
            and stored.key not in snapshot.holdings
            and not _has_model(snapshot, use.id)
            and ages.failed_jobs is not None
            and not unclear
        ):
            yield _failed(stored, 0, use.last_heard, ages.failed_jobs)


def _capture(snapshot: Snapshot, ages: Ages, held: Holding) -> Iterator[Planned]:
    if not held.whole:
        yield _orphan(held, ages, "It has no capture.json: its deletion or creation was cut off.")
    elif ages.captures is not None and held.owner is not None:  # None: its record cannot be read
        used = snapshot.last_used[held.key]
        yield Planned("capture", held, held.size, used + ages.captures, _unused("It", ages.captures))


def _model(snapshot: Snapshot, ages: Ages, held: Holding) -> Iterator[Planned]:
    if held.whole and ages.models is not None:
        work = snapshot.holdings.get(Holding(kind=StoredKind.job, id=held.id).key)
        size = held.size + (work.size if work is not None else 0)
        due = snapshot.last_used[held.key] + ages.models
        yield Planned("job", held, size, due, _unused("The model", ages.models))
    elif not held.whole and held.id not in snapshot.jobs:
        yield _orphan(held, ages, "It has no job.json, and there is no such job.")


def _job(snapshot: Snapshot, ages: Ages, held: Holding) -> Iterator[Planned]:
    used, known = snapshot.last_used[held.key], held.id in snapshot.jobs
    has_model = _has_model(snapshot, held.id)
    if not (known or held.whole or has_model):
        yield _orphan(held, ages, "There is no such job, and no model of it.")
    if not has_model and (known or held.whole) and ages.failed_jobs is not None:
        yield _failed(held, held.size, used, ages.failed_jobs)
    if held.derived and ages.work is not None:
        reason = f"The job ended {_age(ages.work)} ago or earlier; only a restart would need these files."
        yield Planned("work", held, held.derived, used + ages.work, reason)


def _has_model(snapshot: Snapshot, job_id: str) -> bool:
    model = snapshot.holdings.get(Holding(kind=StoredKind.model, id=job_id).key)
    return model is not None and model.whole


def _failed(held: Holding, size: int, used: float, age: float) -> Planned:
    reason = f"The job ended without a model {_age(age)} ago or earlier."
    return Planned("job", held, size, used + age, reason)


def _orphan(held: Holding, ages: Ages, reason: str) -> Planned:
    return Planned("orphan", held, held.size, held.modified + ages.orphans, reason)


def _unused(what: str, age: float) -> str:
    return f"{what} was not used for {_age(age)}."


def _age(seconds: float) -> str:
    return f"{seconds / 86400:g} days" if seconds >= 86400 else format_duration(seconds)

"""Deletes what no record names: digests without files in storage, and keys of jobs without a row in Redis."""

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, cast

import redis

from splatmill.backplane import keys, lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Role
from splatmill_server.jobs.restoring import without_row

_PAGE = 1000


def delete_digests(storage: Storage, seconds: float) -> int:
    """Delete digests older than `seconds` whose files never came, and return their number.

    An upload that takes up such a digest at the same moment keeps it: it is put back if the file is there afterwards.
    """
    before, deleted = time.time() - seconds, 0
    for capture_id in storage.children(layout.captures()):
        held = {entry.path: entry for entry in storage.walk(layout.capture(capture_id))}
        for path, entry in held.items():
            place = layout.digest_of(path)
            if place is None or entry.modified.timestamp() >= before:
                continue
            file = layout.capture_file(capture_id, Role(place[0]), place[1])
            if file in held or storage.exists(file):
                continue
            try:
                digest = storage.get(path)
            except FileNotFoundError:
                continue
            storage.delete(path)
            deleted += 1
            if storage.exists(file):
                storage.put_new(path, digest)
                deleted -= 1
    return deleted


def tidy_redis(connection: redis.Redis, seconds: float) -> dict[str, int]:
    """Repair the list of jobs, and delete keys of jobs without a row that were not used for `seconds`.

    Return the numbers of what was done: rows listed again, ids of the list without a row, and keys deleted.
    """
    relisted = unlisted = deleted = 0
    for page in _pages(connection, f"{keys.job('*')}"):
        jobs = {
            name: job_id
            for name in page
            if (job_id := keys.job_of(name)) is not None and layout.is_id(job_id)
        }
        rows = [job_id for name, job_id in jobs.items() if name == keys.job(job_id)]
        for job_id in _not_listed(connection, rows):
            relisted += _list_again(connection, job_id)
        rowless = set(without_row(connection, sorted({*jobs.values()} - {*rows})))
        for name, job_id in jobs.items():
            if job_id in rowless and _idle(connection, name) >= seconds:
                deleted += connection.delete(name)
    listed = [member.decode() for member in cast(list[bytes], connection.zrange(keys.JOBS, 0, -1))]
    for start in range(0, len(listed), _PAGE):
        for job_id in without_row(connection, listed[start : start + _PAGE]):
            unlisted += _unlist(connection, job_id)
    return {"rows listed again": relisted, "ids without a row": unlisted, "keys without a row": deleted}


def _pages(connection: redis.Redis, pattern: str) -> Iterator[list[str]]:
    cursor = 0
    while True:
        cursor, names = cast(tuple[int, list[bytes]], connection.scan(cursor, match=pattern, count=_PAGE))
        yield [name.decode("utf-8", "replace") for name in names]
        if not cursor:
            return


def _idle(connection: redis.Redis, name: str) -> float:
    """Return the seconds since a key was last used, or 0 if Redis does not say."""
    try:
        return float(cast(Any, connection.object("idletime", name)) or 0.0)
    except redis.ResponseError:  # the policy maxmemory-policy *-lfu keeps no times
        return 0.0


def _not_listed(connection: redis.Redis, job_ids: list[str]) -> list[str]:
    """Return those of the jobs that the list of jobs lacks."""
    if not job_ids:
        return []
    scores = connection.zmscore(keys.JOBS, job_ids)
    return [job_id for job_id, score in zip(job_ids, scores, strict=True) if score is None]


def _list_again(connection: redis.Redis, job_id: str) -> int:
    """Put a row into the list of jobs, and among the unfinished jobs, which the reaper sorts."""

    def repair(pipe: Any) -> None:
        created = pipe.hget(keys.job(job_id), "created_at")
        known = pipe.exists(keys.job(job_id))
        pipe.multi()
        if known:
            # The reaper sorts it into the lists when it has ended.
            pipe.zadd(keys.JOBS, {job_id: _milliseconds(created)}, nx=True)
            pipe.sadd(keys.ACTIVE, job_id)

    connection.transaction(repair, keys.job(job_id))
    return 1


def _milliseconds(created: bytes | None) -> int:
    try:
        return int(datetime.fromisoformat((created or b"").decode()).timestamp() * 1000)
    except ValueError:
        return int(datetime.now(UTC).timestamp() * 1000)


def _unlist(connection: redis.Redis, job_id: str) -> int:
    """Remove an id from the list of jobs if there is no row."""
    removed = 0

    def remove(pipe: Any) -> None:
        nonlocal removed
        removed = 0 if pipe.exists(keys.job(job_id)) else 1
        pipe.multi()
        if removed:
            lists.remove_job(pipe, job_id, None, None)
            pipe.srem(keys.ACTIVE, job_id)

    connection.transaction(remove, keys.job(job_id))
    return removed

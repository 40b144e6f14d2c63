"""Whether Redis, storage and what the API lists tell the same of every capture, job and model."""

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any, cast

import redis

from splatmill.backplane import keys, lists
from splatmill.backplane.jobs import events, row
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.queue import leases, lines
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage

Listed = Mapping[str, Sequence[str]]
"""The ids that the API lists, by kind: captures, jobs and models."""


def remains(
    connection: redis.Redis, storage: Storage, restartable: Collection[str] = ()
) -> dict[str, list[str]]:
    """Return what is still held of work, where no job is unfinished, by what it is. Raises UnreadableRecord.

    restartable: jobs that were cancelled, whose work in storage is kept for a restart.
    """
    kept = tuple(f"{layout.job_work(job)}/" for job in restartable)
    waiting = lines.look(connection)
    marks = [layout.unfinished_jobs(), layout.unfinished_imports(), layout.due_deliveries()]
    leftovers: dict[str, list[str]] = {
        "unfinished jobs": [job.decode() for job in cast(set[bytes], connection.smembers(keys.ACTIVE))],
        "leases": [lease.member for lease in leases.held(connection)],
        "waiting entries": [name for name in lines.LINES if waiting.count(name) > 0],
        "locks": [key.decode() for key in connection.scan_iter(match=keys.lock("*"))],
        "marks of work in storage": [entry.path for mark in marks for entry in storage.walk(mark)],
        "checkpoints in storage": [
            entry.path
            for entry in storage.walk(layout.jobs())
            if "/work/" in entry.path and not entry.path.startswith(kept)
        ],
    }
    return {what: held for what, held in leftovers.items() if held}


def compare(
    connection: redis.Redis, storage: Storage, listed: Listed, accepted: Collection[str]
) -> list[str]:
    """Return a sentence for each record on which they differ, where no job is unfinished.

    accepted: ids of the captures that the service has told a client it made.
    """
    stored = {
        "captures": _with(storage, layout.captures(), "capture.json"),
        "jobs": _with(storage, layout.jobs(), "log.jsonl"),
        "models": _with(storage, layout.models(), "job.json"),
    }
    differences = [
        f"the capture {lost} was accepted and is lost" for lost in sorted(set(accepted) - stored["captures"])
    ]
    kinds: tuple[lists.Kind, ...] = ("captures", "jobs", "models")
    for kind in kinds:
        indexed = _members(connection, lists.name(kind))
        differences += _differ(kind, stored[kind], set(indexed), "storage", "Redis")
        differences += _differ(kind, stored[kind], set(listed[kind]), "storage", "the API's list")
        differences += [f"{one} is listed {listed[kind].count(one)} times" for one in _doubled(listed[kind])]
    for job in sorted(stored["jobs"]):
        differences += _job(connection, storage, job, job in stored["models"])
    for name in connection.scan_iter(match=f"{keys.PREFIX}job:*", count=1000):
        job_id = keys.job_of(name.decode())
        if job_id not in stored["jobs"]:
            differences.append(f"Redis holds {name.decode()}, and storage has no such job")
    return differences


def _job(connection: redis.Redis, storage: Storage, job: str, modelled: bool) -> list[str]:
    """Compare a job's row and states, its log, its lists and its model."""
    known = row.read(connection, job)
    if known is None:
        return [f"{job} is in storage, and Redis has no row of it"]
    told = fold(known, events.read_states(connection, job))
    state = told.state.value
    ended = json.loads(storage.get(layout.job_log(job)).splitlines()[0])
    accounts: dict[str, dict[str, Any]] = {
        "Redis": {
            "state": state,
            "generation": known.generation,
            "capture": known.capture,
            "owner": known.owner,
        },
        "its log": {name: ended["job"].get(name) for name in ("state", "capture", "owner")}
        | {"generation": ended["generation"]},
    }
    if modelled:
        record = json.loads(storage.get(layout.job_record(job)))
        accounts["its model"] = {
            name: record.get(name) for name in ("state", "generation", "capture", "owner")
        }
    differences = []
    for place, account in accounts.items():
        for name, value in account.items():
            if value != accounts["Redis"][name]:
                differences.append(
                    f"{name} of {job} is {value} in {place} and {accounts['Redis'][name]} in Redis"
                )
    if modelled != (state == "succeeded"):
        differences.append(f"{job} is {state}, and storage has {'a' if modelled else 'no'} model of it")
    grouped = {
        group for group in lists.GROUPS if connection.zscore(lists.name("jobs", group=group), job) is not None
    }
    if grouped != {state}:
        differences.append(f"{job} is {state} and in the lists of {sorted(grouped)}")
    return differences


def _with(storage: Storage, folder: str, name: str) -> set[str]:
    """Return the ids of the folders in a folder of storage that have a file of this name."""
    paths = (entry.path.split("/") for entry in storage.walk(folder))
    return {parts[1] for parts in paths if parts[2:] == [name]}


def _members(connection: redis.Redis, name: str) -> list[str]:
    return [member.decode() for member in cast(list[bytes], connection.zrange(name, 0, -1))]


def _differ(kind: str, one: set[str], other: set[str], here: str, there: str) -> list[str]:
    return [
        *(f"{kind}: {name} is in {here} and not in {there}" for name in sorted(one - other)),
        *(f"{kind}: {name} is in {there} and not in {here}" for name in sorted(other - one)),
    ]


def _doubled(ids: Sequence[str]) -> list[str]:
    return sorted({one for one in ids if ids.count(one) > 1})

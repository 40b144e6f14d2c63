"""What must hold when a soak has ended: nothing lost, run twice or left over, and two stores that agree."""

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from _soak.clients import FINAL, Clients, Promise
from _soak.service import Service, wait_for
from splatmill.backplane import events, keys, layout, leases, lines
from splatmill.backplane.records import UnreadableRecord
from splatmill.backplane.storage import Storage
from splatmill.schema import Role, StateEvent

SETTLE_SECONDS = 180.0
"""Seconds for the last jobs to end once no fault comes any more."""

_AGREE_SECONDS = 40.0  # for the reaper to look once more


def settle(clients: Clients) -> list[str]:
    """Wait for every job to end; return a sentence for each that does not."""
    with suppress(AssertionError):
        wait_for(lambda: not clients.unfinished(), SETTLE_SECONDS, "every job has ended")
    return [f"{promise.job} is still {promise.state}" for promise in clients.unfinished()]


def check(service: Service, clients: Clients) -> list[str]:
    """Return a sentence for each thing that does not hold, while the service runs and no job does."""
    storage = service.storage()
    return [
        *clients.complaints,
        *_lost(service, clients, storage),
        *twice(service.records()),
        *_told_twice(service),
        *halves(clients.promises.values(), storage),
        *_disagreements(service, clients, storage),
    ]


def check_stopped(service: Service) -> list[str]:
    """Return a sentence for each process that the stopped service has left behind."""
    left = service.left()
    for process in _marked(service.trace):
        left.append(process)
    return [f"process {pid} still runs: {_command(pid)}" for pid in sorted(set(left))]


def _lost(service: Service, clients: Clients, storage: Storage) -> list[str]:
    found = []
    listed = _listed(service, "jobs")
    models = _listed(service, "models")
    for promise in clients.promises.values():
        if promise.failure is not None:
            found.append(f"{promise.job} failed: {promise.failure}")
            continue
        if promise.state not in FINAL:
            continue  # `settle` tells
        if listed.count(promise.job) != 1:
            found.append(f"{promise.job} is listed {listed.count(promise.job)} times among the jobs")
        if promise.state == "succeeded" and models.count(promise.job) != 1:
            found.append(f"{promise.job} is listed {models.count(promise.job)} times among the models")
    return found


def _listed(service: Service, what: str) -> list[str]:
    """Return the ids of all pages of a list."""
    ids: list[str] = []
    cursor: str | None = None
    while True:
        parameters = {"limit": "100"} | ({"cursor": cursor} if cursor else {})
        page = service.http.get(f"/v1/{what}", params=parameters).raise_for_status().json()
        ids += [item["id"] for item in page[what]]
        cursor = page.get("cursor")
        if cursor is None:
            return ids


def twice(records: Iterable[Any]) -> list[str]:
    """Return a sentence for each attempt that began while another at the same job ran.

    records: the lines of the pipelines' record.
    """
    return [
        f"two attempts at {line['job']} ran at once, one of them process {line['pid']}"
        for line in records
        if line["what"] == "begin" and line["overlap"]
    ]


def _told_twice(service: Service) -> list[str]:
    """Jobs that clients were told of twice that they have succeeded."""
    found = []
    ended = {line["job"] for line in service.records() if line["what"] == "end"}
    with service.redis() as connection:
        for job in sorted(ended):
            stored = events.read_states(connection, job)
            told = [s for s in stored if isinstance(s.event, StateEvent) and s.event.state == "succeeded"]
            if len(told) > len({s.generation for s in told}):
                found.append(f"{job} was told to have succeeded {len(told)} times")
    return found


def halves(promises: Iterable[Promise], storage: Storage) -> list[str]:
    """Return a sentence for each file that is not what was uploaded, or not what the model's record says."""
    found = []
    for promise in promises:
        for name, content in promise.files.items():
            role, _, file = name.partition("/")
            path = layout.capture_file(promise.capture, Role(role), file)
            try:
                if storage.get(path) != content:
                    found.append(f"{path} is not what was uploaded")
            except FileNotFoundError:
                found.append(f"{path} was uploaded and is missing")
        if promise.state != "succeeded":
            continue
        try:
            record = json.loads(storage.get(layout.job_record(promise.job)))
        except (FileNotFoundError, ValueError) as error:
            found.append(f"the record of the model {promise.job} cannot be read: {error}")
            continue
        for name, digest in record["sha256"].items():
            path = layout.model_file(promise.job, name)
            try:
                whole = hashlib.sha256(storage.get(path)).hexdigest() == digest
            except FileNotFoundError:
                whole = False
            if not whole:
                found.append(f"{path} is not whole")
    return found


def _disagreements(service: Service, clients: Clients, storage: Storage) -> list[str]:
    """What Redis still holds of jobs that have ended, and models without a job or the other way round."""
    found: list[str] = []
    with service.redis() as connection:
        remains: dict[str, Any] = {}

        def clean() -> bool:
            remains["unfinished jobs"] = [job.decode() for job in connection.smembers(keys.ACTIVE)]  # type: ignore[union-attr]  # redis types its replies as awaitable
            remains["leases"] = [lease.member for lease in leases.held(connection)]
            remains["waiting entries"] = [
                f"{count} of {name}"
                for name in lines.LINES
                if (count := lines.look(connection).count(name)) > 0
            ]
            remains["locks"] = [key.decode() for key in connection.scan_iter(match=keys.lock("*"))]
            return not any(remains.values())

        try:
            wait_for(clean, _AGREE_SECONDS, "Redis holds no work")
        except AssertionError:
            found += [f"Redis still holds {what}: {held}" for what, held in remains.items() if held]
        except UnreadableRecord as error:
            found.append(f"Redis holds a record that cannot be read: {error}")
    for promise in clients.promises.values():
        published = storage.exists(layout.job_record(promise.job))
        if published != (promise.state == "succeeded"):
            found.append(
                f"{promise.job} is {promise.state}, but storage has {'a' if published else 'no'} model of it"
            )
    return found


def _marked(trace: Path) -> list[int]:
    """Return the processes whose environment names the record of this soak."""
    mark = f"SOAK_TRACE={trace}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def _command(pid: int) -> str:
    try:
        return (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:200]
    except OSError:
        return "it has just ended"

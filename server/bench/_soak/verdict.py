"""What must hold when a soak has ended: nothing lost, run twice or left over, and two stores that agree."""

import hashlib
import time
from contextlib import suppress
from pathlib import Path

import httpx
import redis

from _soak import agreement, attempts, files
from _soak.clients import CAMERA, FINAL, Clients
from _soak.orphans import command
from _soak.service import Service, wait_for
from _soak.target import STARTED_BY_THE_SOAK, Target
from splatmill.backplane.jobs import events
from splatmill.backplane.storage.records import UnreadableRecord
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import StateEvent

SETTLE_SECONDS = 90.0
"""Seconds for the last jobs to end once no fault comes any more, times the patience of the soak."""

_AGREE_SECONDS = 30.0
"""Seconds for Redis, storage and the API's lists to agree once all jobs have ended."""

_ANSWER_SECONDS = 120.0  # for a page of models of which each is read from storage for the first time


def settle(clients: Clients) -> list[str]:
    """Wait for every job to end; return a sentence for each that does not."""
    clients.submit_no_more()
    seconds = SETTLE_SECONDS * clients.service.patience
    with suppress(AssertionError):
        wait_for(lambda: not clients.unfinished(), seconds, "every job has ended")
    return [
        f"{promise.job} is still {promise.state} {seconds:g} s after the last fault"
        for promise in clients.unfinished()
    ]


def check(service: Service, clients: Clients) -> list[str]:
    """Return a sentence for each thing that does not hold, while the service runs and no job does."""
    storage = service.storage()
    records = service.records()
    with service.redis() as connection:
        try:
            listed, differences = _agreed(service, connection, storage, clients)
            unread = _unread(service, clients)
        except httpx.HTTPError as error:
            return [*clients.complaints, f"the service does not answer after all faults: {error!r}"]
        return [
            *clients.complaints,
            *lost(clients, listed["jobs"], listed["models"]),
            *unread,
            *attempts.overlapping(records),
            *attempts.repeated(records),
            *attempts.run_again(records),
            *told_twice(connection, {line["job"] for line in records}),
            *files.halves(clients.promises.values(), storage),
            *files.strays(storage, _cancelled(clients)),
            *differences,
        ]


def check_stopped(service: Service) -> list[str]:
    """Return a sentence for each process that the stopped service has left behind."""
    left = {*service.left(), *_marked(service.trace), *service.orphans()}
    return [f"process {pid} still runs: {command(pid)}" for pid in sorted(left)]


def met(service: Service, target: Target) -> list[str]:
    """Return a sentence for each thing that a whole soak should have met, and has not."""
    sentences = [
        f"a process was met and never killed: the {role}"
        for role in sorted(service.processes.roles - target.killed.keys() - STARTED_BY_THE_SOAK)
    ]
    if not attempts.resumptions(service.records()):
        sentences.append("no attempt trained on from a checkpoint")
    return sentences


def lost(clients: Clients, jobs: list[str], models: list[str]) -> list[str]:
    """Return a sentence for each job that failed, or that is not where it should be.

    jobs, models: ids of those that the API lists.
    """
    sentences = []
    for promise in clients.promises.values():
        if promise.failure is not None:
            sentences.append(f"{promise.job} failed: {promise.failure}")
        elif promise.state in FINAL:  # `settle` judges the others
            if promise.job not in jobs:
                sentences.append(f"{promise.job} was accepted and is not among the jobs")
            if (promise.state == "succeeded") != (promise.job in models):
                there = "is" if promise.job in models else "is not"
                sentences.append(f"{promise.job} is {promise.state} and {there} among the models")
    return sentences


def _unread(service: Service, clients: Clients) -> list[str]:
    """Models that a client cannot download as they are in storage, or cannot look at."""
    sentences = []
    for promise in clients.promises.values():
        if promise.state != "succeeded":
            continue
        address = f"/v1/models/{promise.job}"
        record = service.http.get(f"{address}/files/job.json")
        model = service.http.get(f"{address}/files/model.ply")
        if record.status_code != 200 or model.status_code != 200:
            sentences.append(f"{address} cannot be downloaded: {record.status_code}, {model.status_code}")
        elif hashlib.sha256(model.content).hexdigest() != record.json()["sha256"]["model.ply"]:
            sentences.append(f"{address}/files/model.ply is not what its record says")
        view = service.http.post(f"{address}/render", json={"camera": CAMERA})
        if not view.content.startswith(b"\x89PNG"):
            sentences.append(f"{address} cannot be looked at: {view.status_code} {view.text[:200]}")
    return sentences


def _listed(service: Service, what: str) -> list[str]:
    """Return the ids of all pages of a list."""
    ids: list[str] = []
    cursor: str | None = None
    while True:
        parameters = {"limit": "100"} | ({"cursor": cursor} if cursor else {})
        page = (
            service.http.get(f"/v1/{what}", params=parameters, timeout=_ANSWER_SECONDS)
            .raise_for_status()
            .json()
        )
        ids += [item["id"] for item in page[what]]
        cursor = page.get("cursor")
        if cursor is None:
            return ids


def told_twice(connection: redis.Redis, jobs: set[str]) -> list[str]:
    """Return a sentence for each job whose states tell more than once in a generation that it has succeeded."""
    sentences = []
    for job in sorted(jobs):
        stored = events.read_states(connection, job)
        told = [s for s in stored if isinstance(s.event, StateEvent) and s.event.state == "succeeded"]
        if len(told) > len({s.generation for s in told}):
            sentences.append(f"{job} was told to have succeeded {len(told)} times")
    return sentences


def _agreed(
    service: Service, connection: redis.Redis, storage: Storage, clients: Clients
) -> tuple[dict[str, list[str]], list[str]]:
    """Return what the API lists, and where Redis, storage and that differ once the service has had time to repair."""
    end = time.monotonic() + _AGREE_SECONDS * service.patience
    while True:
        listed = {kind: _listed(service, kind) for kind in ("captures", "jobs", "models")}
        try:
            held = agreement.remains(connection, storage, _cancelled(clients))
            differences = [f"there are still {what}: {names}" for what, names in held.items()]
            differences += agreement.compare(connection, storage, listed, clients.captures)
        except UnreadableRecord as error:
            differences = [f"Redis holds a record that cannot be read: {error}"]
        if not differences or time.monotonic() > end:
            return listed, differences
        time.sleep(1)


def _cancelled(clients: Clients) -> list[str]:
    return [promise.job for promise in clients.promises.values() if promise.state == "cancelled"]


def _marked(trace: Path) -> list[int]:
    """Return the processes whose environment names the record of this soak."""
    mark = f"SOAK_TRACE={trace}".encode()
    pids = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                pids.append(int(folder.name))
        except OSError:
            continue
    return pids

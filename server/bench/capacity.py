"""What a hundred thousand captures, jobs and models cost: pages of lists, memory of Redis, start-up, followers.

    splatmill bench capacity                     # a hundred thousand of each, a thousand followers; some ten minutes
    splatmill bench capacity --records 2000 --followers 100
    splatmill bench capacity --storage s3        # two thousand of each, on moto's S3 server

Records are seeded as the service stores them (`_capacity/seed.py`). Redis is a process of its own, storage a folder or
an S3 server on this machine, which answers some hundred requests a second and is there to count them, not to time them.
A page is asked of the app in this process, where its operations are counted; the rest is measured on a server process.

Expected before it was measured: a page takes 2 to 3 round trips and under 100 ms anywhere in a list; an ended job and
its model take under 10 kB; lists are made at some thousand records a second, bound by the parsing of records.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any

import _s3_server
import httpx
import psutil
import structlog
from _capacity.followers import Served, follow_all
from _capacity.operations import counted
from _capacity.seed import FIRST, Seeded, seed
from _capacity.table import sections
from _private_redis import running
from _rows import Row
from _studies.study import Study

from splatmill.backplane import keys, memory
from splatmill.backplane.connection import connect
from splatmill.backplane.storage.storage import Storage
from splatmill_server.app import create_app
from splatmill_server.base.paging import write_cursor
from splatmill_server.base.settings import Settings
from splatmill_server.service import Service

HERE = Path(__file__).resolve().parent

RECORDS = {"folder": 100_000, "s3": 2000}
"""Records of each kind, by where they are stored."""

PAGE = 50
REPEATS = 5


def measured(options: argparse.Namespace) -> Iterator[Row]:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    with (
        tempfile.TemporaryDirectory(prefix="capacity") as name,
        running(Path(name)) as url,
        _s3_server.running("capacity") if options.storage == "s3" else nullcontext() as bucket,
    ):
        records = options.records or RECORDS[options.storage]
        yield from measure(Path(name), url, records, options.followers, bucket)


def measure(
    folder: Path, redis_url: str, records: int, followers: int, bucket: str | None = None
) -> Iterator[Row]:
    """Yield a row for each thing that is measured, over `records` captures, jobs and models in an empty folder.

    bucket: URL of an empty bucket in which they lie instead.
    """
    settings = Settings(redis_url=redis_url, data=folder, access_log=False, storage=bucket or "")
    began = time.perf_counter()
    seeded = seed(Storage(settings.storage), records)
    about = {"records": records, "storage_in": "folder" if bucket is None else "s3"}
    yield {**about, "what": "seeding", "seconds": time.perf_counter() - began}
    app = create_app(settings)
    service: Service = app.state.service
    yield {**about, **_timed("lists made from storage", service, lambda: service.lists.ensure(0.0))}
    yield {**about, **_memory("after the lists were made", service)}
    service.redis.delete(keys.RESTORED)  # no worker claims them
    yield {**about, **_timed("first look of the reaper", service, service.reaper.tick)}
    yield {**about, **_timed("each later look of the reaper", service, service.reaper.tick)}
    for row in asyncio.run(_pages(app, service, seeded)):
        yield {**about, **row}
    yield {**about, **_memory("after each model was listed", service)}
    service.redis.close()
    for what, emptied in (("start with its lists", False), ("start with an empty Redis", True)):
        with connect(redis_url) as connection:
            if emptied:
                connection.flushall()
        began = time.perf_counter()
        with _server(settings) as served:
            ready = time.perf_counter() - began
            while served.http.get("/v1/jobs", params={"limit": PAGE}).status_code != 200:
                time.sleep(0.05)
            row = {"seconds": ready, "first_page": time.perf_counter() - began}
            yield {**about, "what": what, **row}
    with _server(settings) as served:
        yield {**about, "what": "followers", **follow_all(served, redis_url, followers)}


async def _pages(app: Any, service: Service, seeded: Seeded) -> list[Row]:
    """Time and count pages at the beginning, in the middle and at the end of each list."""
    count = len(seeded.captures)
    rows = []
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost", timeout=600) as http:
        for kind in ("captures", "jobs", "models"):
            for where, after in (("first", None), ("middle", count // 2), ("last", PAGE)):
                rows.append(await _page(http, service, kind, where, {}, after))
            rows.append(await _page(http, service, kind, "of an owner", {"owner": "owner3"}, None))
            rows.append(await _page(http, service, kind, "of a rare name", {"name": f" {count - 7}"}, None))
        for state in ("queued", "failed", "succeeded", "training"):
            rows.append(await _page(http, service, "jobs", state, {"state": state}, None))
        capture = {"capture": seeded.captures[count // 3]}
        rows.append(await _page(http, service, "jobs", "on a capture", capture, None))
    return rows


async def _page(
    http: httpx.AsyncClient, service: Service, kind: str, where: str, asked: dict[str, str], after: int | None
) -> Row:
    """Ask for a page once for its first reading, and several times for its time and its operations.

    The operations are those of the repeat with the fewest: into some falls what the server reads now and then, such as
    the keys of its API.
    """
    params: dict[str, Any] = {"limit": PAGE, **asked}
    if after is not None:
        params["cursor"] = write_cursor(int((FIRST.timestamp() + after) * 1000), f"{after:016x}")
    with counted() as cold:
        began = time.perf_counter()
        (await http.get(f"/v1/{kind}", params=params)).raise_for_status()
        first = time.perf_counter() - began
    seconds, cpu, round_trips, storage = [], [], [], []
    for _ in range(REPEATS):
        with counted() as operations:
            began, busy = time.perf_counter(), time.process_time()
            answer = (await http.get(f"/v1/{kind}", params=params)).raise_for_status().json()
            seconds.append(time.perf_counter() - began)
            cpu.append(time.process_time() - busy)
        round_trips.append(operations.round_trips)
        storage.append(sum(operations.storage.values()))
    return {
        "what": "page",
        "list": kind,
        "where": where,
        "found": len(answer[kind]),
        "seconds": median(seconds),
        "cpu_seconds": median(cpu),
        "round_trips": min(round_trips),
        "storage": min(storage),
        "first_seconds": first,
        "first_storage": sum(cold.storage.values()),
    }


def _timed(what: str, service: Service, act: Any) -> Row:
    """Time something, and count its operations."""
    with counted() as operations:
        began = time.perf_counter()
        act()
        seconds = time.perf_counter() - began
    counts = {"round_trips": operations.round_trips, "storage": sum(operations.storage.values())}
    return {"what": what, "seconds": seconds, **counts}


def _memory(when: str, service: Service) -> Row:
    """Return the memory of Redis."""
    return {"what": f"memory {when}", "bytes": memory.read(service.redis).used}


@contextmanager
def _server(settings: Settings) -> Iterator[Served]:
    """Run an API process until it is ready."""
    environment = os.environ | {
        "REDIS_URL": settings.redis_url,
        "SPLATMILL_DATA": str(settings.data),
        "SPLATMILL_STORAGE": settings.storage,
    }
    path = settings.data / "api.sock"
    command = [sys.executable, "-m", "splatmill_server", "--uds", str(path)]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    transport = httpx.HTTPTransport(uds=str(path))
    try:
        with httpx.Client(transport=transport, base_url="http://localhost", timeout=600) as http:
            while not _listens(path) or http.get("/readyz").status_code != 200:
                if process.poll() is not None:
                    raise RuntimeError(f"The API process ended with status {process.returncode}.")
                time.sleep(0.02)
            yield Served(http, path, psutil.Process(process.pid))
    finally:
        process.terminate()
        process.wait(30)


def _listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0


STUDY = Study(
    name="capacity",
    about=__doc__,
    cases={"records": measured},
    key=("records", "storage_in", "what", "list", "where"),
    home=HERE,
    parts=("server", "client"),
    blocks={"sections": sections},
    figures={},
    options={
        "storage": {"choices": list(RECORDS), "default": "folder"},
        "records": {"type": int, "help": "of each kind (default: 100000, on s3 2000)"},
        "followers": {"type": int, "default": 1000, "help": "of events (default: 1000)"},
    },
)
main = STUDY.main

"""What a fleet of workers asks of one Redis and of the API: the rate of jobs, idle workers, running jobs.

    splatmill bench fleet                                # 10, 100, 300 and 1000 workers; some five minutes
    splatmill bench fleet --workers 10 --jobs 50 --seconds 3

Redis is a process of its own that stores as `splatmill up` lets it. Workers are simulated in a few processes
(`_fleet/workers.py`): they register, take jobs, send heartbeats and events, store models and settle by the worker's own
code, and train nothing. The API is this process: jobs are created by its endpoint, and its reaper retires them. All of
them share the cores of one machine, so a rate is one of the machine; what each part spends on a job is not.
sizing.md has what it comes to for a service.

Expected before it was measured: an idle worker makes two round trips a second, a training one ten (four events, each
with a question before it, one look for onlookers, and heartbeats), and a job takes a hundred. Redis spends 20
microseconds on each, so that a thousand workers that train take a fifth of a core. What grows with the square of the
number costs more: each worker looks every ten seconds whether each other is still recorded, and at its start reads
each.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import redis
import structlog
from _capacity.operations import counted
from _fleet import meter
from _fleet.api import Api
from _fleet.sizing import write_sizing
from _fleet.table import TABLES
from _private_redis import running
from _rows import Row, footer
from _studies.study import Study

from splatmill.backplane import keys
from splatmill.backplane.connection import connect
from splatmill.backplane.queue import leases, rq_keys
from splatmill.backplane.queue.entries import open_queue, split_rq_id
from splatmill_server.base.settings import Settings

HERE = Path(__file__).resolve().parent

PROCESSES = 4
"""Processes in which workers are simulated."""

TRAINING = 300
"""Workers that train at once, at most; the others of a fleet wait. Each sends four events a second, and two cores can
simulate no more of them."""

_LONGEST = 600.0
"""Seconds after which something that does not come is given up."""

_STORING = {"appendonly": "yes", "appendfsync": "everysec", "maxclients": "20000"}


def measured(options: argparse.Namespace) -> Iterator[Row]:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    for count in options.workers:
        with tempfile.TemporaryDirectory(prefix="fleet") as name, running(Path(name), **_STORING) as url:
            yield from measure(Path(name), url, count, options.jobs, options.seconds)


def measure(folder: Path, url: str, workers: int, jobs: int, seconds: float) -> Iterator[Row]:
    """Yield a row for the start of so many workers, for their idleness, for the rate of jobs, and for their training.

    folder: for storage and the workers' files.
    seconds: length of each look at idle and at training workers.
    """
    api = Api(Settings(redis_url=url, data=folder, access_log=False))
    with connect(url) as connection, Fleet(folder, url) as fleet:
        about: Row = {"workers": workers}
        before = meter.look(connection)
        fleet.start(workers)
        yield {**about, "what": "start", **_started(fleet, before, meter.look(connection))}
        yield {**about, "what": "idle", **_window(fleet, connection, seconds), "look": api.look()}
        yield {**about, "what": "rate", **_rate(fleet, api, connection, jobs)}
        yield {**about, "what": "training", **_training(fleet, api, connection, folder, seconds)}


class Fleet:
    """Simulated workers in PROCESSES processes."""

    def __init__(self, folder: Path, url: str) -> None:
        self._environment = {
            name: value for name, value in os.environ.items() if not name.startswith("SPLATMILL_")
        } | {
            "REDIS_URL": url,
            "SPLATMILL_DATA": str(folder),
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self._processes: list[subprocess.Popen[str]] = []
        self.count = 0
        self.first: Row = {}

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._processes:
            cast(Any, process.stdin).close()
        for process in self._processes:
            process.wait(60)
            cast(Any, process.stdout).close()

    def start(self, count: int) -> None:
        """Start so many workers, and wait until all have registered."""
        shares = [count // PROCESSES + (number < count % PROCESSES) for number in range(PROCESSES)]
        for share in filter(None, shares):
            command = [sys.executable, "-m", "_fleet.workers", str(share)]
            self._processes.append(
                subprocess.Popen(
                    command,
                    env=self._environment,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
        self.count = count
        self.first = self._read()

    def counts(self) -> Row:
        """Return what all workers together have counted since their start."""
        for process in self._processes:
            stdin = cast(Any, process.stdin)
            stdin.write("\n")
            stdin.flush()
        return self._read()

    def _read(self) -> Row:
        readings = [json.loads(cast(Any, process.stdout).readline()) for process in self._processes]
        return {name: sum(counts[name] for counts in readings) for name in readings[0]}


def _started(fleet: Fleet, before: meter.Look, after: meter.Look) -> Row:
    return {
        "seconds": after.at - before.at,
        "round_trips": fleet.first["round_trips"] / fleet.count,
        "connections": (after.connections - before.connections) / fleet.count,
        "bytes": (after.memory - before.memory) / fleet.count,
    }


def _window(fleet: Fleet, connection: redis.Redis, seconds: float) -> Row:
    """Look at the fleet for some seconds: round trips and CPU seconds for each worker and second, and Redis."""
    counts, before = fleet.counts(), meter.look(connection)
    time.sleep(seconds)
    after, later = meter.look(connection), fleet.counts()
    length = after.at - before.at
    each = {
        name: (later[name] - counts[name]) / length / fleet.count for name in ("round_trips", "cpu_seconds")
    }
    return {
        "seconds": length,
        "round_trips": each["round_trips"],
        "worker_cpu": each["cpu_seconds"],
        "events": meter.calls(before, after, "xadd") / length / fleet.count,
        "connections": after.connections / fleet.count,
        "bytes": after.memory,
        **meter.between(before, after),
    }


def _rate(fleet: Fleet, api: Api, connection: redis.Redis, jobs: int) -> Row:
    """Let the fleet end so many jobs without training. What each part spends is that for one job."""
    capture = api.capture(None)
    counts, before, polls = fleet.counts(), meter.look(connection), 0
    cpu, began = time.process_time(), time.monotonic()
    with counted() as creating:
        api.create(capture, jobs)
    created, created_cpu = time.monotonic() - began, time.process_time() - cpu
    ended = open_queue(connection).finished_job_registry.key
    with counted() as retiring, api.looking():
        polls += _until(lambda: connection.zcard(ended) == jobs)
        seconds = time.monotonic() - began
        polls += _until(lambda: connection.scard(keys.ACTIVE) == 0)
    retired_cpu = time.process_time() - cpu - created_cpu
    after, later, cpu = meter.look(connection), fleet.counts(), time.process_time()
    with counted() as shrinking:
        api.shrink()
    shrunk_cpu = time.process_time() - cpu
    api.require_none_failed()
    return {
        "jobs": jobs,
        "seconds": seconds,
        "per_second": jobs / seconds,
        "created_per_second": jobs / created,
        "cpu": {
            "create": created_cpu / jobs,
            "retire": retired_cpu / jobs,
            "shrink": shrunk_cpu / jobs,
            "worker": (later["cpu_seconds"] - counts["cpu_seconds"]) / jobs,
            "redis": (after.cpu - before.cpu) / jobs,
        },
        "round_trips": {
            "create": creating.round_trips / jobs,
            "retire": (retiring.round_trips - polls) / jobs,
            "shrink": shrinking.round_trips / jobs,
            "worker": (later["round_trips"] - counts["round_trips"]) / jobs,
        },
        "storage": {
            "create": sum(creating.storage.values()) / jobs,
            "retire": sum(retiring.storage.values()) / jobs,
            "worker": (later["storage"] - counts["storage"]) / jobs,
        },
        "written": (creating.written + retiring.written + later["written"] - counts["written"]) / jobs,
        "bytes": (after.memory - before.memory) / jobs,
        "kept_bytes": (meter.look(connection).memory - before.memory) / jobs,
        **meter.between(before, after),
    }


def _training(fleet: Fleet, api: Api, connection: redis.Redis, folder: Path, seconds: float) -> Row:
    """Let up to TRAINING workers run a job each, and look at them, at the reaper, and at a page of the running ones."""
    jobs = min(fleet.count, TRAINING)
    over = folder / "over"
    capture, idle = api.capture(over), meter.look(connection)
    api.create(capture, jobs)

    def begun() -> bool:
        api.require_none_failed()
        return connection.zcard(rq_keys.STARTED) == jobs and _under_way(connection)

    _until(begun)
    time.sleep(1.0)  # for streams of more than one entry
    window = _window(fleet, connection, seconds)
    entry = _entry_bytes(connection)
    looked, page = (
        min((api.look() for _ in range(3)), key=lambda row: (row["round_trips"], row["cpu_seconds"])),
        min((api.page("training") for _ in range(3)), key=lambda row: row["cpu_seconds"]),
    )
    over.touch()
    with api.looking():
        _until(lambda: connection.scard(keys.ACTIVE) == 0)
    more = {"jobs": jobs, "bytes_each": (window["bytes"] - idle.memory) / jobs, "entry_bytes": entry}
    return {**window, **more, "look": looked, "page": page}


def _under_way(connection: redis.Redis) -> bool:
    """Return whether every attempt has sent progress: it has staged its capture."""
    with connection.pipeline(transaction=False) as pipe:
        for lease in leases.held(connection):
            pipe.exists(keys.progress(split_rq_id(lease.entry)[0]))
        return all(pipe.execute())


def _entry_bytes(connection: redis.Redis) -> float:
    """Return how many bytes of Redis an entry of the stream of progress takes, of a job that runs."""
    job_id, _ = split_rq_id(leases.held(connection)[0].entry)
    stream = keys.progress(job_id)
    whole: Any = connection.memory_usage(stream, samples=0)
    return int(whole) / int(connection.xlen(stream))


def _until(condition: Callable[[], bool]) -> int:
    """Wait until something holds, and return how often it was looked at. Raises TimeoutError after _LONGEST."""
    end, looks = time.monotonic() + _LONGEST, 1
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"The fleet has not come to the end of its jobs in {_LONGEST:.0f} s.")
        time.sleep(0.05)
        looks += 1
    return looks


STUDY = Study(
    name="fleet",
    about=__doc__,
    cases={"workers": measured},
    key=("workers", "what"),
    order=lambda row: (row["workers"], row["what"]),
    home=HERE,
    parts=("server", "client"),
    blocks={**TABLES, "footer": footer},
    figures={},
    options={
        "workers": {"type": int, "nargs": "+", "default": [10, 100, 300, 1000]},
        "jobs": {"type": int, "default": 600, "help": "jobs of the rate (default: 600)"},
        "seconds": {"type": float, "default": 20.0, "help": "of each look at a fleet (default: 20)"},
    },
)


def main(argv: list[str]) -> int:
    options = STUDY.parser().parse_args(argv)
    status = STUDY.main(argv)
    if not options.dry:
        sizing = options.out / "sizing.md"
        write_sizing(STUDY.place(options.out), HERE / "results" / "capacity.jsonl", sizing)
    return status

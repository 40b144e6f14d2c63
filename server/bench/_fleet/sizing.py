"""What the rows of `bench fleet` and `bench capacity` come to for services of some sizes: a part of `docs/sizing.md`.

Every number is one of the rows or follows from them by the formula in its line.
"""

from collections.abc import Sequence
from pathlib import Path

from _rows import Row, footer, lines

from splatmill.backplane import keys
from splatmill.backplane.jobs import events

MINUTES = 10
"""Minutes that a job takes in the examples."""

DAYS = 30
"""Days for which ended jobs are kept in the examples."""

MILLION = 1_000_000
_DAY = 86_400
_LOOK_SECONDS = 10.0  # SPLATMILL_REAPER_INTERVAL
_BUSY = 0.5  # share of a core that a process of the API is to use at most
_API_CONNECTIONS = 75  # of one process: 40 threads, 32 of those who follow events, and some more
_IDLE_CONNECTIONS = 2  # of a worker that waits
_MOST_PROGRESS = events.BOUNDS[keys.progress] or 0  # entries of the stream of progress of a job


def write_sizing(fleet_rows: Path, capacity_rows: Path, page: Path) -> None:
    """Write what one worker and one job cost, and what services of some sizes come to, if there are rows of both."""
    fleet, capacity = lines(fleet_rows), lines(capacity_rows)
    whats = {row["what"] for row in fleet}
    if not {"idle", "rate", "training"} <= whats or not any("bytes" in row for row in capacity):
        return
    cost = Cost(fleet, capacity)
    text = ["| one | costs | measured with |", "|---|---|---|", *cost.described(), ""]
    text += _scenarios(cost)
    page.write_text("\n".join([*text, "", footer([*cost.rows]), ""]))


class Cost:
    """What one of each costs, from the rows of the largest fleet and of the most records.

    idle, training: share of a core of Redis for a worker.
    job: CPU seconds of Redis for a job.
    api: CPU seconds of the API for a job: creation, end, shrinking.
    look: CPU seconds of a look of the reaper for a running job.
    storage: operations for a job, those of the worker included.
    written: bytes of storage for a job, without its photos and its Gaussians.
    running: bytes of Redis for a running job whose stream of progress is full.
    kept: bytes of Redis for an ended job, with its capture and model.
    connections: of a worker that trains.
    """

    def __init__(self, fleet: Sequence[Row], capacity: Sequence[Row]) -> None:
        most = max(row["workers"] for row in fleet if row["what"] == "training")
        named = {row["what"]: row for row in fleet if row["workers"] == most}
        idle, rate, training = named["idle"], named["rate"], named["training"]
        records = max((row for row in capacity if "bytes" in row), key=lambda row: row["records"])
        self.rows = [idle, rate, training, records]
        self.workers, self.records = most, int(records["records"])
        self.idle = idle["redis_cpu"] / most
        waiting = most - training["jobs"]
        self.training = (training["redis_cpu"] - waiting * self.idle) / training["jobs"]
        self.job = rate["cpu"]["redis"]
        self.api = sum(rate["cpu"][part] for part in ("create", "retire", "shrink"))
        self.look = training["look"]["cpu_seconds"] / training["jobs"]
        self.storage = sum(rate["storage"].values())
        self.written = rate["written"]
        self.running = rate["bytes"] + _MOST_PROGRESS * training["entry_bytes"]
        self.kept = records["bytes"] / records["records"]
        self.connections = (training["connections"] * most - waiting * _IDLE_CONNECTIONS) / training["jobs"]

    def described(self) -> list[str]:
        """Return the lines of the table of what one of each costs."""
        fleet, records = f"{self.workers} simulated workers", f"{self.records} records"
        rows = [
            ("worker that waits", f"{100 * self.idle:.4f} % of a core of Redis", fleet),
            ("worker that trains", f"{100 * self.training:.3f} % of a core of Redis", fleet),
            ("worker that trains", f"{self.connections:.1f} connections to Redis", fleet),
            ("job", f"{1e3 * self.job:.1f} ms of a core of Redis", fleet),
            ("job", f"{1e3 * self.api:.1f} ms of a core of the API", fleet),
            ("running job, each look of the reaper", f"{1e3 * self.look:.2f} ms of a core of the API", fleet),
            ("job", f"{self.storage:.0f} operations of storage", fleet),
            ("job", f"{self.written / 1e3:.0f} kB of records in storage, without photos and models", fleet),
            ("running job, with a full stream of progress", f"{self.running / 1e3:.0f} kB of Redis", fleet),
            ("ended job, with its capture and model", f"{self.kept / 1e3:.1f} kB of Redis", records),
        ]
        return [f"| {what} | {costs} | {by} |" for what, costs, by in rows]


def _scenarios(cost: Cost) -> list[str]:
    """Return the table of services of some sizes: a column for each, a line for each figure with its formula."""
    sizes = [(workers, workers * _DAY / (60 * MINUTES)) for workers in (10, 100, 1000)]
    sizes.append((round(MILLION * 60 * MINUTES / _DAY), float(MILLION)))
    heads = [f"{workers:,} workers" for workers, _ in sizes[:3]] + ["a million jobs a day"]
    text = ["| " + " | ".join(["", "formula", *heads]) + " |", "|---|---|" + "---:|" * len(sizes)]

    def line(what: str, formula: str, cells: Sequence[str]) -> None:
        text.append("| " + " | ".join([what, formula, *cells]) + " |")

    line("workers that train (W)", f"jobs × {MINUTES} min / 1 day", [f"{workers:,}" for workers, _ in sizes])
    line("jobs a day (J)", f"W × 1 day / {MINUTES} min", [f"{jobs:,.0f}" for _, jobs in sizes])
    redis_cpu = [workers * cost.training + jobs / _DAY * cost.job for workers, jobs in sizes]
    line(
        "Redis, % of its one core",
        f"W × {100 * cost.training:.3f} % + J / 86,400 s × {1e3 * cost.job:.1f} ms",
        [f"{100 * share:.1f}" for share in redis_cpu],
    )
    line(
        "Redis, memory for running jobs",
        f"W × {cost.running / 1e3:.0f} kB",
        [_bytes(workers * cost.running) for workers, _ in sizes],
    )
    line(
        f"Redis, memory for {DAYS} days of ended jobs",
        f"J × {DAYS} × {cost.kept / 1e3:.1f} kB",
        [_bytes(jobs * DAYS * cost.kept) for _, jobs in sizes],
    )
    api_cpu = [jobs / _DAY * cost.api + workers * cost.look / _LOOK_SECONDS for workers, jobs in sizes]
    line(
        "API, % of a core, without its clients' requests",
        f"J / 86,400 s × {1e3 * cost.api:.1f} ms + W × {1e3 * cost.look:.2f} ms / {_LOOK_SECONDS:.0f} s",
        [f"{100 * share:.1f}" for share in api_cpu],
    )
    processes = [max(1, -(-share // _BUSY)) for share in api_cpu]
    line("API, processes for that", f"share / {_BUSY}, at least 1", [f"{count:.0f}" for count in processes])
    line(
        "connections to Redis",
        f"W × {cost.connections:.1f} + processes × {_API_CONNECTIONS}",
        [
            f"{workers * cost.connections + count * _API_CONNECTIONS:,.0f}"
            for (workers, _), count in zip(sizes, processes, strict=True)
        ],
    )
    line(
        "operations of storage a day, without photos",
        f"J × {cost.storage:.0f}",
        [f"{jobs * cost.storage:,.0f}" for _, jobs in sizes],
    )
    line(
        "records in storage a day",
        f"J × {cost.written / 1e3:.0f} kB",
        [_bytes(jobs * cost.written) for _, jobs in sizes],
    )
    return text


def _bytes(count: float) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count / 1e3:.0f} kB"

"""The page of `bench fleet`, from its rows."""

from collections.abc import Callable, Sequence
from pathlib import Path

from _rows import Row, footer, lines

HEAD = """# A fleet of simulated workers

What 10 to 1,000 workers ask of one Redis and of the API. `splatmill bench fleet` writes the rows
(`results/fleet.jsonl`) and this page. Workers are simulated, and train nothing; all they do with Redis and with
storage is the worker's own code (`_fleet/workers.py`). Redis keeps its log on the disk; storage is a folder. All parts
share the machine named below, so that jobs a second and shares of a core are those of this machine under this load, and
CPU seconds, round trips and bytes are those of the part. What the numbers come to for a service is in `docs/sizing.md`.
"""

_IDLE = """## Workers that wait

Registered, without jobs: a heartbeat and a look for jobs every five seconds, a look for lost leases every ten.
"""

_RATE = """## The rate of jobs

Jobs that end at once, from their creation by `POST /v1/jobs` to the end that the last worker tells. CPU milliseconds,
round trips to Redis and operations of storage are those for one job: the API creates it, a worker runs it, the reaper
stores its log and its end, and a minute later shrinks its streams. The worker's are those of the simulation, which
forks no process.
"""

_TRAINING = """## Simulated trainings

Up to 300 workers run a job, each with a progress event every quarter of a second, which is the most that a worker
sends; the others wait. "Of one" is an average over all of them.
"""

Column = tuple[str, Callable[[Row], str]]


def write_table(rows_at: Path, page: Path) -> None:
    """Write the page for the newest rows of each number of workers."""
    newest: dict[tuple[int, str], Row] = {}
    for row in lines(rows_at):
        newest[row["workers"], row["what"]] = row
    rows = [newest[key] for key in sorted(newest)]
    if rows:
        text = [HEAD, _IDLE, _table(_of(rows, "start"), _START), _table(_of(rows, "idle"), _WAITING)]
        text += [_RATE, _table(_of(rows, "rate"), _JOBS), _top(_of(rows, "rate"))]
        text += [_TRAINING, _table(_of(rows, "training"), _RUNNING), _top(_of(rows, "training"))]
        page.write_text("\n".join([*text, footer(rows), ""]))


def _of(rows: Sequence[Row], what: str) -> list[Row]:
    return [row for row in rows if row["what"] == what]


def _table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    text = [
        f"| {' | '.join(['workers', *(head for head, _ in columns)])} |",
        "|---:" * (len(columns) + 1) + "|",
    ]
    text += [f"| {' | '.join([str(row['workers']), *(cell(row) for _, cell in columns)])} |" for row in rows]
    return "\n".join([*text, ""])


def _top(rows: Sequence[Row]) -> str:
    """Say what takes the time of Redis where most workers are, if that was measured."""
    row = rows[-1] if rows else {}
    named = ", ".join(f"`{name}` {100 * share:.0f} %" for name, share in row.get("of_cpu", {}).items())
    if not named:
        return ""
    return (
        f"With {row['workers']} workers, these commands take most of the processor time of Redis: {named}. A script "
        "(`eval`, `evalsha`) counts beside the commands that it runs; the rest is its reading and writing.\n"
    )


def _each(*names: str, factor: float = 1.0, digits: int = 1) -> Callable[[Row], str]:
    """Return a cell with the value under these names, one below the other."""

    def cell(row: Row) -> str:
        value = row
        for name in names:
            value = value[name]
        return f"{factor * float(value):.{digits}f}"  # type: ignore[arg-type]  # a number at the end of the path

    return cell


_START: list[Column] = [
    ("seconds until all are registered", _each("seconds")),
    ("round trips of one", _each("round_trips", digits=0)),
    ("connections of one", _each("connections")),
    ("kB of Redis for one", _each("bytes", factor=1e-3, digits=0)),
]
_WAITING: list[Column] = [
    ("round trips of one a second", _each("round_trips", digits=2)),
    ("commands a second", _each("commands", digits=0)),
    ("% of a core, Redis", _each("redis_cpu", factor=100)),
    ("kB/s to Redis", _each("received", factor=1e-3, digits=0)),
    ("kB/s from Redis", _each("sent", factor=1e-3, digits=0)),
    ("round trips of a look of the reaper", _each("look", "round_trips", digits=0)),
    ("its CPU ms", _each("look", "cpu_seconds", factor=1e3)),
]
_JOBS: list[Column] = [
    ("jobs", _each("jobs", digits=0)),
    ("jobs a second", _each("per_second")),
    *(
        (f"CPU ms: {part}", _each("cpu", part, factor=1e3))
        for part in ("create", "retire", "shrink", "worker", "redis")
    ),
    *(
        (f"round trips: {part}", _each("round_trips", part, digits=0))
        for part in ("create", "retire", "shrink", "worker")
    ),
    *((f"storage: {part}", _each("storage", part, digits=0)) for part in ("create", "retire", "worker")),
    ("kB written to storage", _each("written", factor=1e-3)),
    ("kB of Redis, ended", _each("bytes", factor=1e-3)),
    ("kB of Redis, shrunk", _each("kept_bytes", factor=1e-3)),
]
_RUNNING: list[Column] = [
    ("of them train", _each("jobs", digits=0)),
    ("events of one a second", _each("events")),
    ("round trips of one a second", _each("round_trips")),
    ("commands a second", _each("commands", digits=0)),
    ("% of a core, Redis", _each("redis_cpu", factor=100)),
    ("kB/s to Redis", _each("received", factor=1e-3, digits=0)),
    ("kB/s from Redis", _each("sent", factor=1e-3, digits=0)),
    ("connections of one", _each("connections")),
    ("kB of Redis for one", _each("bytes_each", factor=1e-3, digits=0)),
    ("round trips of a look of the reaper", _each("look", "round_trips", digits=0)),
    ("its CPU ms", _each("look", "cpu_seconds", factor=1e3)),
    ("CPU ms of a page of 50 running jobs", _each("page", "cpu_seconds", factor=1e3)),
]

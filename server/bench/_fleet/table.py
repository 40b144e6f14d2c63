"""The page of `bench fleet`, from its rows."""

from collections.abc import Callable, Sequence
from functools import partial

from _page import Column, of_rows
from _rows import Row, of


def _table(what: str, columns: Sequence[Column], rows: list[Row]) -> str:
    heads = [("workers:", "{workers}"), *((f"{head}:", cell) for head, cell in columns)]
    return of_rows(heads, of(rows, what=what))


def _top(what: str, rows: list[Row]) -> str:
    """What takes the time of Redis where most workers are, if that was measured."""
    row = max(of(rows, what=what), key=lambda row: int(row["workers"]), default={})
    named = ", ".join(f"`{name}` {100 * share:.0f} %" for name, share in row.get("of_cpu", {}).items())
    if not named:
        return ""
    return (
        f"With {row['workers']} workers, these commands take most of the processor time of Redis: {named}. A script "
        "(`eval`, `evalsha`) counts beside the commands that it runs; the rest is its reading and writing."
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

TABLES = {
    "start": partial(_table, "start", _START),
    "idle": partial(_table, "idle", _WAITING),
    "rate": partial(_table, "rate", _JOBS),
    "rate of Redis": partial(_top, "rate"),
    "training": partial(_table, "training", _RUNNING),
    "training of Redis": partial(_top, "training"),
}
"""The blocks of the page."""

"""The table of the README on what the service survives and how fast it answers, from the newest rows of its benches.

    splatmill bench summary      # after soak, load, abuse, capacity, fleet, openapi or fuzz

Each bench writes its own page; this writes a line of each into the README, between two comments. A test compares them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import abuse
from _page import filled
from _rows import Row, footer, lines
from _soak.words import jobs, kills

HERE = Path(__file__).resolve().parent
README = HERE.parents[1] / "README.md"

CLIENTS = 200
"""Clients of the line about load."""


def main(argv: list[str]) -> int:
    """Write the table into the README, and print it."""
    if argv:
        print("splatmill bench summary takes no arguments.", file=sys.stderr)
        return 2
    README.write_text(filled(README.read_text(), {"summary": table()}))
    print(table())
    return 0


def table(results: Path = HERE / "results") -> str:
    """Return the table of the rows in a folder; a bench without rows has no line."""
    text = ["| what was done to it | what came of it |", "|---|---|"]
    used: list[Row] = []
    for name, told in TOLD.items():
        rows = lines(results / f"{name}.jsonl")
        for done, came, of in told(rows):
            text.append(f"| {done} | {came}; [more](server/bench/{name}.md) |")
            used += of
    return "\n".join([*text, "", footer(used)])


Told = Iterable[tuple[str, str, list[Row]]]


def _soak(rows: list[Row]) -> Told:
    for storage, words in (("folder", "a folder"), ("s3", "S3")):
        group = [row for row in rows if row["storage"] == storage]
        ends = [row for row in group if row["fault"] is None]
        if not ends:
            continue
        end = ends[-1]
        held = "nothing lost, run twice or left over, and no job failed of a fault"
        if end["complaints"]:
            held = f"**{len(end['complaints'])} things did not hold**"
        waits = [row["resumes"] for row in group if row.get("resumes") is not None]
        back = f"; jobs went on within {max(waits):.0f} s" if waits else ""
        yield (
            f"{end['faults']} faults, {end['killed']} of them kills ({kills(group)}), while {end['jobs']} jobs of the "
            f"engine ran: {jobs(end)}; storage in {words}",
            held + back,
            [end],
        )


def _load(rows: list[Row]) -> Told:
    newest = {row["what"]: row for row in rows if row["clients"] == CLIENTS and row["training"]}
    if {"job", "view"} <= newest.keys():
        job, view = newest["job"], newest["view"]
        errors = sum(row["errors"] for row in newest.values())
        yield (
            f"{CLIENTS} clients for {job['seconds']:.0f} s, beside a training on the same cores",
            f"a job in {job['p50_ms']:.0f} ms (p99 {job['p99_ms']:.0f}), a view of 640x480 in {view['p50_ms']:.0f} ms "
            f"(p99 {view['p99_ms']:.0f}), {errors} errors",
            [job],
        )


def _abuse(rows: list[Row]) -> Told:
    if not rows:
        return
    alone, abused = abuse.newest(rows)
    figures = [
        f"{what} {abuse.shown(abuse.median(abused, name))} ({abuse.shown(abuse.median(alone, name))})"
        for name, what in (
            ("waiting_s", "its job starts after"),
            ("first_event_s", "its first event comes after"),
            ("import_s", "its import takes"),
            ("webhook_s", "its webhook comes after"),
        )
    ]
    row = abused[-1]
    yield (
        "one owner abuses events, uploads, imports, webhooks, its quota and a link at once, while another trains",
        f"of the other, beside what it is alone: {', '.join(figures)}; of {row['limit'] / 1e6:.1f} MB that the first "
        f"may store, it held {row['most_bytes'] / 1e6:.1f} MB at most",
        [row],
    )


def _capacity(rows: list[Row]) -> Told:
    if not rows:
        return
    most = max(row["records"] for row in rows)
    newest = {(row["what"], row.get("list"), row.get("where")): row for row in rows if row["records"] == most}
    pages = [row for row in newest.values() if row["what"] == "page"]
    memory = [row["bytes"] for row in newest.values() if "bytes" in row]
    if pages and memory:
        slowest = max(pages, key=lambda row: row["seconds"])
        yield (
            f"{most} captures, jobs and models",
            f"the slowest page of 50 in {1000 * slowest['seconds']:.0f} ms ({slowest['list']}: {slowest['where']}), "
            f"Redis holds {max(memory) / 1e6:.0f} MB",
            [slowest],
        )


def _fleet(rows: list[Row]) -> Told:
    rates = {row["workers"]: row for row in rows if row["what"] == "rate"}
    if rates:
        most = rates[max(rates)]
        yield (
            f"{most['workers']} simulated workers on one Redis",
            f"{most['per_second']:.0f} simulated jobs a second, which train nothing, with all of them on these cores; "
            f"{1000 * most['cpu']['redis']:.1f} ms of Redis a job",
            [most],
        )


def _openapi(rows: list[Row]) -> Told:
    if rows:
        row = rows[-1]
        failed = sum(failure["count"] for failure in row["failures"]) + len(row["errors"] + row["unexpected"])
        yield (
            f"{row['requests']} requests made up from the OpenAPI document, in sequences",
            f"{failed} failed checks",
            [row],
        )


def _fuzz(rows: list[Row]) -> Told:
    newest = list({row["parser"]: row for row in rows}.values())
    if newest:
        faults = sum(bool(row["fault"]) for row in newest)
        yield (
            f"{sum(row['inputs'] for row in newest)} changed files for {len(newest)} parsers",
            f"{faults} crashed, hung or took too much memory",
            newest[:1],
        )


TOLD: dict[str, Callable[[list[Row]], Told]] = {
    "soak": _soak,
    "load": _load,
    "abuse": _abuse,
    "capacity": _capacity,
    "fleet": _fleet,
    "openapi": _openapi,
    "fuzz": _fuzz,
}
"""What each bench is told to say, by the name of its rows and its page."""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

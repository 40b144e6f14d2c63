"""Faults at random moments against the running service, and the proof that it loses nothing.

    splatmill bench soak                                 # 200 kills and some 90 other faults; some 40 minutes
    splatmill bench soak --storage s3
    splatmill bench soak --faults 30 --seed 7
    splatmill bench soak --only "decoder of the trainer killed" "worker killed"
    splatmill bench soak --plot-only

`splatmill up` runs with a Redis behind a proxy, on a small disk where this user may mount one, with a clock that can be
set. Clients upload, start jobs, cancel some, look at models and have them converted, all the while. Every job is one of
the engine (`_soak/work.py`): small photos, of which most come without cameras, and videos; some are scenes in tiles.

The processes that are killed are found by descent from the supervisor (`_soak/processes.py`), whatever part of the
service started them, and each role of a process is killed as often as the others. A job is spared once its process or
its worker was killed so often that the next kill might end it by design (`_soak/target.py`).

Within 30 s of a fault's end the service answers, takes a capture and shows a model, every job that had begun has got on
or ended, and no process has lost its parent (`_soak/recovery.py`); the time in which the only worker trains other jobs,
up to a minute, is not counted for a job that waits for it. One fault in four is followed by the
next at once instead, after which the jobs of both must get on. At the end every job that was accepted has its model, of
all its photos, or its cancellation, no two attempts at a job ran at once, no step whose checkpoint was stored was taken
again, no cameras that were stored were recovered again, no attempt did a unit of a scene in tiles again that it or an
earlier one had stored, no pipeline ran for a model that was stored, no process is left, every file in storage is whole
and explained by a record, and Redis, storage and the API's lists agree on every capture, job and model
(`_soak/verdict.py`). Otherwise the exit status is 1, with a sentence for each thing that does not hold.

Rows go to results/soak.jsonl, the table to soak.md. A seed fixes the faults and their order, not the moments at which
the machine does what.
"""

from __future__ import annotations

import argparse
import math
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from _rows import Row, append, footer, lines, origin, rows_file
from _soak import attempts, faults, verdict, words, work
from _soak.clients import Clients
from _soak.recovery import MEASURED, RESUME_SECONDS, recover
from _soak.service import Service
from _soak.target import Target

HERE = Path(__file__).resolve().parent

_AT_ONCE = 0.25
"""Share of the faults that are followed by the next without waiting for either."""

_PAUSE = (0.1, 2.5)  # seconds before a fault


def main(argv: list[str]) -> int:
    """Run the soak that is asked for, write its rows and the table, and return 1 if anything does not hold."""
    parser = argparse.ArgumentParser(
        prog="splatmill bench soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--faults", type=int, help=f"number of faults (default: until {faults.KILLS} are kills)"
    )
    parser.add_argument("--seconds", type=float, help="end with the fault after so many seconds")
    parser.add_argument(
        "--only", nargs="+", metavar="FAULT", help="each of these once, by the names of the table"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--storage", choices=["folder", "s3"], default="folder")
    parser.add_argument(
        "--patience",
        type=float,
        default=1.0,
        help="multiply all time limits, for a machine that has other work",
    )
    parser.add_argument("--keep", type=Path, help="copy logs and the record of the attempts to this folder")
    parser.add_argument("--results", type=rows_file, default=HERE / "results" / "soak.jsonl")
    parser.add_argument("--plot-only", action="store_true", help="write the table of the rows that are there")
    asked = parser.parse_args(argv)
    table = HERE / "soak.md" if asked.results.parent == HERE / "results" else asked.results.with_suffix(".md")
    complaints: list[str] = []
    if not asked.plot_only:
        new_rows = soak(
            s3=asked.storage == "s3",
            count=asked.faults,
            seed=asked.seed,
            seconds=asked.seconds,
            only=asked.only,
            patience=asked.patience,
            keep=asked.keep,
        )
        complaints = new_rows[-1]["complaints"]
        kept = [row for row in lines(asked.results) if row["storage"] != asked.storage]
        asked.results.unlink(missing_ok=True)
        for row in kept + [row | origin("server", "client") for row in new_rows]:
            append(asked.results, row)
    rows = lines(asked.results)
    if not rows:
        print(f"There are no rows in {asked.results}.", file=sys.stderr)
        return 1
    table.write_text(document(rows))
    print(table.read_text())
    for complaint in complaints:
        print(f"FAULT: {complaint}", file=sys.stderr)
    return 1 if complaints else 0


def soak(
    *,
    s3: bool,
    count: int | None,
    seed: int,
    seconds: float | None = None,
    only: Sequence[str] | None = None,
    patience: float = 1.0,
    keep: Path | None = None,
) -> list[Row]:
    """Run one soak and return a row for each fault, and a last one for the whole.

    count, seconds: the soak ends with the earlier of the two. Without a count there are `faults.KILLS` kills.
    only: names of faults; each comes once if this soak can have it, and `count` says nothing.
    patience: what time limits are multiplied by, for a machine that has other work.
    """
    rng = random.Random(seed)
    rows: list[Row] = []
    begun = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    service = Service(folder, s3=s3, patience=patience)
    try:
        service.start()
        possible, left_out = faults.possible(service)
        clients = Clients(service, seed, work.captures())
        clients.start()
        target = Target(service, rng)
        whole = count is None and only is None and seconds is None
        count = faults.enough(possible) if count is None else count
        same = {"bench": "soak", "storage": "s3" if s3 else "folder", "seed": seed}
        for number, fault in enumerate(faults.schedule(possible, count, rng, only)):
            if seconds is not None and time.monotonic() - begun > seconds:
                break
            time.sleep(rng.uniform(*_PAUSE))
            row = same | {"number": number, "fault": fault.name, "kills": fault.kills}
            row |= _one(service, clients, target, fault, rng.random() < _AT_ONCE, begun)
            rows.append(row)
            _say(row)
        complaints = [
            f"fault {row['number']} ({row['fault']}): {row['complaint']}" for row in rows if row["complaint"]
        ]
        over = time.monotonic()
        complaints += verdict.settle(clients)
        settled = time.monotonic() - over
        clients.stop()
        complaints += verdict.check(service, clients)
        if whole:
            complaints += verdict.met(service, target)
        service.stop()
        complaints += verdict.check_stopped(service)
        end = _summary(rows, clients, time.monotonic() - begun, settled, left_out, complaints)
        resumed = attempts.resumptions(service.records())
        rows.append(same | end | {"resumed": resumed, "roles": dict(target.killed), "patience": patience})
    finally:
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            for path in (*folder.glob("*.log"), *folder.glob("data/logs/*"), service.trace):
                shutil.copy(path, keep)
        service.close()
    return rows


def _one(
    service: Service,
    clients: Clients,
    target: Target,
    fault: faults.Fault,
    at_once: bool,
    begun: float,
) -> Row:
    """Do a fault, and measure until all works again."""
    target.strike()
    target.victim = None
    row: Row = {"complaint": None, **dict.fromkeys(MEASURED)}
    clients.faults.append((fault.name, math.inf))
    try:
        if fault.loses:
            target.lose_worker()
        fault.act(target)
    except AssertionError as error:
        row["complaint"] = str(error)
        target.healed = time.monotonic()
    clients.faults[-1] = fault.name, target.healed
    if target.victim is not None:
        row["fault"] = faults.kill_of(target.victim).name
    row["at"] = round(target.struck - begun, 2)
    row["lasted"] = round(target.healed - target.struck, 2)
    if not at_once and row["complaint"] is None:
        measured, row["complaint"] = recover(service, clients, target.struck, target.healed)
        row |= {what: round(seconds, 2) for what, seconds in measured.items()}
    return row


def _summary(
    rows: list[Row],
    clients: Clients,
    seconds: float,
    settled: float,
    left_out: dict[str, str],
    complaints: list[str],
) -> Row:
    """Return the row of the whole.

    settled: seconds that the last jobs took to end.
    """
    states = [promise.state for promise in clients.promises.values()]
    return {
        "fault": None,
        "seconds": round(seconds),
        "settled": round(settled, 1),
        "faults": len(rows),
        "killed": sum(row["kills"] for row in rows),
        "jobs": len(states),
        "kinds": dict(Counter(work.KINDS[promise.kind] for promise in clients.promises.values())),
        "succeeded": states.count("succeeded"),
        "cancelled": states.count("cancelled"),
        "restarts": sum(promise.restarts for promise in clients.promises.values()),
        "views": clients.views,
        "conversions": clients.conversions,
        "retries": clients.retries,
        "left_out": left_out,
        "complaints": complaints,
    }


def document(rows: list[Row]) -> str:
    """Return the page with the table by kind of fault."""
    storages = list(dict.fromkeys(row["storage"] for row in rows))
    done = {row["fault"]: row["kills"] for row in rows if row["fault"] is not None}
    others = [fault.name for fault in faults.FAULTS]
    names = sorted(name for name in done if name not in others) + [name for name in others if name in done]
    text = ["# What the service survives", ""]
    text += [
        "Made by `splatmill bench soak`; the head of `soak.py` says what is done and what must hold.",
        "",
    ]
    for storage in storages:
        text += _storage_part(storage, [row for row in rows if row["storage"] == storage], names)
    text.append(footer(rows))
    return "\n".join(text) + "\n"


def _storage_part(storage: str, rows: list[Row], names: list[str]) -> list[str]:
    end = next(row for row in rows if row["fault"] is None)
    text = [f"## Storage in {'a folder' if storage == 'folder' else 'S3'}", ""]
    text += [
        f"{end['faults']} faults in {end['seconds']} s, {end['killed']} of them kills (seed {end['seed']}): "
        f"{words.kills(rows)}. "
        f"{end['jobs']} jobs of the engine: {words.jobs(end)}. {end['succeeded']} succeeded, {end['cancelled']} were "
        f"cancelled by a client; clients restarted {end['restarts']} after a failure that advises it, got "
        f"{end['views']} views and {end['conversions']} conversions. {end['resumed']} attempts trained on from a "
        "checkpoint.",
        "",
    ]
    if end["complaints"]:
        text += ["**What did not hold:**", "", *(f"- {complaint}" for complaint in end["complaints"]), ""]
    else:
        in_tiles = work.KINDS["tiles"] in end["kinds"]
        units = ", no attempt did a stored unit of a scene in tiles again" if in_tiles else ""
        within = RESUME_SECONDS * end["patience"]
        longest = max(row.get("resumes") or 0.0 for row in rows)
        others = ", the time in which the worker trained other jobs not counted" if longest >= within else ""
        text += [
            f"Within {within:g} s of every fault that no other followed at once, the service "
            f"answered, took a capture and showed a model, and every job that had begun had got on or ended{others}. "
            "Nothing was lost, no job failed of a fault, every model came of all its photos, no two attempts at a "
            f"job ran at once, no step with a stored checkpoint was taken again{units}, no process was left, "
            "every file was whole, and Redis, storage and the API's lists agreed on every record.",
            "",
        ]
    text += [f"Not run: {name}, because {why}." for name, why in end["left_out"].items()]
    text += [""] if end["left_out"] else []
    text += [
        "Seconds from the end of the fault (a kill ends at once, unless the soak itself starts again what it killed): "
        "median (longest).",
        "",
        "| fault | times | waited for | answers | accepts | shows | resumes | failed |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name in names:
        strikes = [row for row in rows if row["fault"] == name]
        if strikes:
            waited = [row for row in strikes if any(row[what] is not None for what in MEASURED)]
            cells = [_seconds([row[what] for row in waited if row[what] is not None]) for what in MEASURED]
            failed = sum(row["complaint"] is not None for row in strikes)
            text.append(f"| {name} | {len(strikes)} | {len(waited)} | {' | '.join(cells)} | {failed} |")
    return [*text, ""]


def _seconds(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({max(values):.1f})" if values else "-"


def _say(row: Row) -> None:
    times = ", ".join(f"{what} {row[what]} s" for what in MEASURED if row[what] is not None)
    print(
        f"{row['number'] + 1} {row['fault']}: {row['complaint'] or times or 'the next at once'}", flush=True
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

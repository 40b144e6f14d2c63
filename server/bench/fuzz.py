"""Every parser of bytes from strangers, with files that are changed at random, for ten minutes each.

    splatmill bench fuzz                           # all parsers, two at a time; two hours
    splatmill bench fuzz --seconds 20 --only zip EXIF
    splatmill bench fuzz --table                   # the page again, from the rows

The parsers and what they are given are those of the tests (`tests/support/hostile/parsers.py`): valid files with bytes
set to extreme numbers, flipped, cut, repeated, removed and inserted, through the code that jobs and requests go
through, a worker's confined decoders and a real server among it. Each parser has a process of its own. It fails if it
dies, if an input takes more than a minute, if its memory grows by more than a gigabyte, or if an input ends otherwise
than with a result or a problem that has a name.

Rows go to results/fuzz.jsonl, the page to fuzz.md. Ends with status 1 if a parser failed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from _rows import Row, append, footer, lines, origin

from tests.support.hostile.parsers import PARSERS

HERE = Path(__file__).resolve().parent
ROWS = HERE / "results" / "fuzz.jsonl"

MEMORY = 1 << 30
"""Bytes by which the process of a parser may grow."""

_START_SECONDS = 300  # for the process, its Redis and its server, on a busy machine


def main(argv: list[str]) -> int:
    """Give files to the parsers, and write rows and page."""
    parser = argparse.ArgumentParser(
        prog="splatmill bench fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="for each parser (default: 600)")
    parser.add_argument("--only", nargs="+", choices=list(PARSERS), metavar="PARSER", help="these parsers")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the first inputs")
    parser.add_argument("--together", type=int, default=2, help="parsers at a time (default: 2)")
    parser.add_argument("--results", type=Path, default=ROWS)
    parser.add_argument("--table", action="store_true", help="write the page from the rows")
    asked = parser.parse_args(argv)
    good = True
    if not asked.table:
        with ThreadPoolExecutor(asked.together) as pool:
            names = asked.only or list(PARSERS)
            for row in pool.map(lambda name: fuzzed(name, asked.seconds, asked.seed), names):
                append(asked.results, row | origin("server", "client"))
                print({key: row[key] for key in ("parser", "inputs", "slowest_seconds", "fault")}, flush=True)
                good &= not row["fault"]
    rows = lines(asked.results)
    if not rows:
        print(f"There are no rows in {asked.results}.", file=sys.stderr)
        return 1
    page = HERE / "fuzz.md" if asked.results == ROWS else asked.results.with_suffix(".md")
    page.write_text(document(rows))
    print(page.read_text())
    return 0 if good else 1


def fuzzed(name: str, seconds: float, seed: int) -> Row:
    """Return a row: what a parser made of the files, and `fault`, which is empty where nothing was wrong."""
    paths = [str(HERE), str(HERE.parents[1])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "_fuzz.one", name, str(seconds), str(seed)]
    about = {"bench": "fuzz", "parser": name, "seconds": seconds, "seed": seed}
    nothing = {"inputs": 0, "outcomes": {}, "slowest_seconds": 0.0, "grown_bytes": 0}
    try:
        ran = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=2 * seconds + _START_SECONDS
        )
    except subprocess.TimeoutExpired:
        return {**about, **nothing, "fault": "it did not end"}
    if ran.returncode:
        return {
            **about,
            **nothing,
            "fault": f"it ended with status {ran.returncode}: {ran.stderr[-3000:]}",
        }
    found: Row = json.loads(ran.stdout.splitlines()[-1])
    grown = found["grown_bytes"] > MEMORY
    return {**about, **found, "fault": f"it grew by {found['grown_bytes']} bytes" if grown else ""}


def document(rows: list[Row]) -> str:
    """Return the page of the newest row of each parser."""
    newest = {row["parser"]: row for row in rows}
    text = ["# Changed files for every parser", ""]
    text += [
        "Made by `splatmill bench fuzz`; the head of `fuzz.py` says what is given and what may come of it.",
        "",
    ]
    text += ["| parser | seconds | inputs | slowest, s | grown, MB | most frequent outcomes | fault |"]
    text += ["|---|---:|---:|---:|---:|---|---|"]
    for name, row in newest.items():
        often = ", ".join(f"{what} {count}" for what, count in list(row["outcomes"].items())[:3])
        fault = row["fault"].splitlines()[0] if row["fault"] else "none"
        text.append(
            f"| {name} | {row['seconds']:.0f} | {row['inputs']} | {row['slowest_seconds']:.2f} "
            f"| {row['grown_bytes'] / 1e6:.0f} | {often} | {fault} |"
        )
    return "\n".join([*text, "", footer(list(newest.values()))]) + "\n"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

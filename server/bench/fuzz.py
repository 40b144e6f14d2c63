"""Every parser of bytes from strangers, with files that are changed at random, for ten minutes each.

    splatmill bench fuzz                           # all parsers, two at a time; two hours
    splatmill bench fuzz --seconds 20 --only zip EXIF

The parsers and what they are given are those of the tests (`tests/support/hostile/parsers.py`): valid files with bytes
set to extreme numbers, flipped, cut, repeated, removed and inserted, through the code that jobs and requests go
through, a worker's confined decoders and a real server among it. Each parser has a process of its own. It fails if it
dies, if an input takes more than a minute, if its memory grows by more than a gigabyte, or if an input ends otherwise
than with a result or a problem that has a name.

Ends with status 1 if a parser failed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from _page import Column, of_rows
from _rows import Row, footer
from _studies.study import Study

from tests.support.hostile.parsers import PARSERS

HERE = Path(__file__).resolve().parent

MEMORY = 1 << 30
"""Bytes by which the process of a parser may grow."""

_START_SECONDS = 300  # for the process, its Redis and its server, on a busy machine


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """Give files to the parsers."""
    with ThreadPoolExecutor(options.together) as pool:
        names = options.only or list(PARSERS)
        for row in pool.map(lambda name: fuzzed(name, options.seconds, options.seed), names):
            yield row
            if row["fault"]:
                yield f"{row['parser']} failed: {row['fault']}"


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
        return {**about, **nothing, "fault": f"it ended with status {ran.returncode}: {ran.stderr[-3000:]}"}
    outcome: Row = json.loads(ran.stdout.splitlines()[-1])
    grown = outcome["grown_bytes"] > MEMORY
    return {**about, **outcome, "fault": f"it grew by {outcome['grown_bytes']} bytes" if grown else ""}


COLUMNS: list[Column] = [
    ("parser", "{parser}"),
    ("seconds:", "{seconds:.0f}"),
    ("inputs:", "{inputs}"),
    ("slowest, s:", "{slowest_seconds:.2f}"),
    ("grown, MB:", lambda row: f"{row['grown_bytes'] / 1e6:.0f}"),
    (
        "most frequent outcomes",
        lambda row: ", ".join(f"{what} {count}" for what, count in list(row["outcomes"].items())[:3]),
    ),
    ("fault", lambda row: row["fault"].splitlines()[0] if row["fault"] else "none"),
]
STUDY = Study(
    name="fuzz",
    about=__doc__,
    cases={"parsers": measured},
    key=("parser",),
    home=HERE,
    parts=("server", "client"),
    blocks={"parsers": partial(of_rows, COLUMNS), "footer": footer},
    figures={},
    options={
        "seconds": {"type": float, "default": 600.0, "help": "for each parser (default: 600)"},
        "only": {"nargs": "+", "choices": list(PARSERS), "metavar": "PARSER", "help": "these parsers"},
        "seed": {"type": int, "default": int(time.time()), "help": "of the first inputs"},
        "together": {"type": int, "default": 2, "help": "parsers at a time (default: 2)"},
    },
)
main = STUDY.main

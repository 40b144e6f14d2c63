"""What one owner who abuses the service costs another who trains beside it.

    splatmill bench abuse                     # three trainings alone, three under abuse: some minutes
    splatmill bench abuse --repetitions 5

One `splatmill up` on this machine with two owners. One uploads a small capture with one photo in pieces, trains it,
follows its events, imports a file and is told of the end by a webhook (`_abuse/trainer.py`), first alone. Then the
other does all of this at once, from one process and with one key whose storage is limited (`_abuse/abuser.py`):

- follows the jobs of the first, with a key that may only read them, from a position that is never reached, so that a
  reader which believed it would wait for ever;
- uploads the same file as the first, in pieces, into several captures;
- has files imported from servers that send a byte every two seconds, never end, or ask to come back in a day;
- has the ends of its jobs told to twenty receivers that never answer;
- edits, converts, renders and restarts in parallel, which the limit of its storage has to stop;
- loads a shared link from eight connections.

Meanwhile the bytes of all its captures, jobs and models are summed ten times a second.
What does not come within a minute is counted as not arrived.

Expected: everything that concerns the first owner takes as long as alone, but for the cores and the one worker, which
the two share: a job waits for at most one of the other's jobs, which end a second or two after they begin, and all that
computes takes about twice as long. The bytes never exceed the limit.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import secrets
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from _abuse.hosts import serving
from _abuse.trainer import LONGEST, Trainer
from _page import table
from _rows import Row, footer
from _still_life import posed_capture
from _studies.study import Study
from _up import served

HERE = Path(__file__).resolve().parent

PHOTOS, WIDTH, HEIGHT = 12, 160, 120
LIMIT = 8_000_000
"""Bytes that the owner who abuses may store: a handful of its models."""

MEASURED = {
    "waiting_s": "until the job starts",
    "first_event_s": "until the first event",
    "job_s": "the job itself, whose work shares the cores",
    "longest_gap_s": "longest time between two events",
    "upload_s": "upload in pieces",
    "import_s": "import",
    "webhook_s": "from the end of the job to its webhook",
}
"""The seconds of a row, and what they are."""


def measure(options: argparse.Namespace) -> Iterator[Row]:
    """Train alone and under abuse."""
    photos = posed_capture(PHOTOS, WIDTH, HEIGHT)
    piecewise = next(path for path in photos if path.startswith("images/"))
    key, run = secrets.token_urlsafe(24), secrets.token_hex(4)
    # Every server of this benchmark is on loopback, at ports that are not known yet.
    settings = {"SPLATMILL_API_KEY": key, "SPLATMILL_OUTGOING_ALLOW": "127.0.0.1"}
    with (
        tempfile.TemporaryDirectory(prefix="splatmill-abuse-") as name,
        serving(photos[piecewise]) as host,
        served(Path(name), settings) as (url, _),
        httpx.Client(
            base_url=url, headers={"Authorization": f"Bearer {key}"}, trust_env=False, timeout=60
        ) as admin,
    ):
        trainer = Trainer(url, _key(admin, "trains", None), photos, piecewise, host)
        abuses = {"read_key": _key(admin, "trains", None, "read")}
        abuses |= _prepared(url, _key(admin, "abuses", LIMIT), photos)
        (Path(name) / Path(piecewise).name).write_bytes(photos[piecewise])
        abuses["photo"] = str(Path(name) / Path(piecewise).name)
        for number in range(options.repetitions):
            yield {"bench": "abuse", "run": run, "abused": False, "repetition": number, **trainer.run()}
        storage = Path(name) / "data" / "storage"
        with _watched(storage, trainer.records) as peak, _abusing(abuses) as answers:
            rows = [trainer.run() for _ in range(options.repetitions)]
        for number, row in enumerate(rows):
            also = {"limit": LIMIT, "most_bytes": peak[0], "answers": answers}
            yield {"bench": "abuse", "run": run, "abused": True, "repetition": number, **row, **also}


def _key(admin: httpx.Client, owner: str, limit: int | None, scope: str = "train") -> str:
    body = {"name": owner, "owner": owner, "limits": {"bytes_stored": limit}, "scopes": [scope]}
    return str(admin.post("/v1/keys", json=body).raise_for_status().json()["secret"])


def _prepared(url: str, key: str, photos: dict[str, bytes]) -> Row:
    """Give the owner who abuses a capture, a model and a link to it."""
    with httpx.Client(
        base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=60, trust_env=False
    ) as http:
        capture = http.post("/v1/captures", json={}).raise_for_status().json()["id"]
        for path, content in photos.items():
            http.put(f"/v1/captures/{capture}/{path}", content=content).raise_for_status()
        options = {"steps": 200, "max_gaussians": 5000, "time_lapse": "off"}
        job = (
            http.post("/v1/jobs", json={"capture": capture, "options": options})
            .raise_for_status()
            .json()["id"]
        )
        state = ""
        while state not in ("succeeded", "failed"):
            time.sleep(0.2)
            state = http.get(f"/v1/jobs/{job}").raise_for_status().json()["state"]
        if state == "failed":
            raise SystemExit(f"The model to abuse could not be trained: {http.get(f'/v1/jobs/{job}').text}")
        link = http.post(f"/v1/models/{job}/shares", json={}).raise_for_status().json()["path"]
    return {"url": url, "key": key, "capture": capture, "model": job, "link": link}


@contextmanager
def _abusing(asked: Row) -> Iterator[dict[str, int]]:
    """Abuse the service meanwhile; what was answered is known afterwards."""
    answers: dict[str, int] = {}
    process = subprocess.Popen(
        [sys.executable, "-m", "_abuse.abuser", json.dumps(asked)],
        env=os.environ | {"PYTHONPATH": str(HERE)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        time.sleep(10)  # until every abuse has begun, and has filled what it can fill
        yield answers
    finally:
        said, _ = process.communicate("", timeout=120)
    if process.returncode:
        raise SystemExit(f"The process that abuses the service ended with status {process.returncode}.")
    answers.update(json.loads(said.splitlines()[-1]))


@contextmanager
def _watched(storage: Path, others: set[str]) -> Iterator[list[int]]:
    """Keep the most bytes that all captures, jobs and models had at once, those of `others` left out."""
    most, stop = [0], threading.Event()

    def look() -> None:
        while not stop.wait(0.1):
            folders = [each for kind in ("captures", "jobs", "models") for each in _entries(storage / kind)]
            most[0] = max(most[0], sum(_size(each) for each in folders if each.name not in others))

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield most
    finally:
        stop.set()
        thread.join()


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except (FileNotFoundError, NotADirectoryError):
        return []  # not made yet, or deleted meanwhile


def _size(entry: os.DirEntry[str]) -> int:
    if entry.is_dir(follow_symlinks=False):
        return sum(map(_size, _entries(Path(entry.path))))
    try:
        return entry.stat(follow_symlinks=False).st_size
    except FileNotFoundError:
        return 0


def median(rows: list[Row], name: str) -> float:
    """The median of a measurement; infinite where most of it did not arrive."""
    return statistics.median(math.inf if row[name] is None else row[name] for row in rows)


def worst(rows: list[Row], name: str) -> float:
    """The largest of a measurement; infinite where one did not arrive."""
    return max(math.inf if row[name] is None else float(row[name]) for row in rows)


def shown(seconds: float) -> str:
    """Seconds as text."""
    return f"over {LONGEST:.0f} s" if math.isinf(seconds) else f"{seconds:.1f} s"


def newest(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """The rows of the newest run: alone, and under abuse."""
    of_run = [row for row in rows if row["run"] == rows[-1]["run"]]
    return [row for row in of_run if not row["abused"]], [row for row in of_run if row["abused"]]


def summary(rows: list[Row]) -> str:
    return (
        "Made by `splatmill bench abuse`; the head of `abuse.py` says what runs, and what was expected. Medians of "
        f"{len(newest(rows)[1])} trainings, and the worst of them in brackets."
    )


def seconds(rows: list[Row]) -> str:
    """What the owner who trains waits for, and what came of its jobs."""
    ways = newest(rows)
    lines = [
        [what, *(f"{shown(median(way, name))} ({shown(worst(way, name))})" for way in ways)]
        for name, what in MEASURED.items()
    ]
    held: dict[str, Callable[[Row], bool]] = {
        "jobs that succeeded": lambda row: row["state"] == "succeeded",
        "event streams that ended with the job": lambda row: row["stream_ended"],
        "uploads without a conflict": lambda row: not row["upload_conflicts"],
    }
    for what, count in held.items():
        lines.append([what, *(f"{sum(map(count, way))} of {len(way)}" for way in ways)])
    return table("of the owner who trains|alone|under abuse", lines)


def stored(rows: list[Row]) -> str:
    last = newest(rows)[1][-1]
    return (
        f"The owner who abuses may store {last['limit'] / 1e6:.1f} MB, and stored {last['most_bytes'] / 1e6:.1f} MB at "
        "most. It got these answers:"
    )


def responses(rows: list[Row]) -> str:
    kinds: dict[str, list[str]] = {}
    for name, count in newest(rows)[1][-1]["answers"].items():
        kind, _, status = name.partition(" ")
        kinds.setdefault(kind, []).append(f"{status}: {count}")
    return table(
        "request|answers, by status or error", ([kind, ", ".join(counts)] for kind, counts in kinds.items())
    )


STUDY = Study(
    name="abuse",
    about=__doc__,
    cases={"trainings": measure},
    key=("run", "abused", "repetition"),
    home=HERE,
    parts=("server", "client"),
    blocks={
        "summary": summary,
        "seconds": seconds,
        "stored": stored,
        "responses": responses,
        "footer": lambda rows: footer([row for way in newest(rows) for row in way]),
    },
    figures={},
    options={
        "repetitions": {"type": int, "default": 3, "help": "trainings alone and under abuse (default: 3)"},
    },
)
main = STUDY.main

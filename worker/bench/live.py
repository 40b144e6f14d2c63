"""What the live view costs a training: nobody can look, nobody looks, and somebody looks all the time.

    splatmill bench live                                    # the still life, 1500 steps, 5 rounds: about 10 minutes
    splatmill bench live --scene fox --steps 3000 --rounds 9

In each round the three runs follow each other in turning order, each in a process of its own, with the same seed,
plan and number of steps. `without` has no live view, as `splatmill train` of earlier versions; `unwatched` has the
worker's thread, which asks a Redis once a second whether anybody looks; `watched` has that key set, and this process
fetches every snapshot, as the server does for a browser. Both also have what the live view itself took: the CPU seconds
of that thread, and the seconds for which training waited for snapshots. Other work on the machine disturbs these two
least. Seconds run from the first step to the export, evaluations and
snapshots included, so that a snapshot cannot hide on a stopped clock. CPU seconds are those of the training process;
other work on the machine disturbs them less.

Expected before it was measured: unwatched within the noise of `without`, watched at most 3 % more. A snapshot may take
2 % of the time (live.SHARE), and Redis' copy the rest.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import _page
import psutil
import redis
from _rows import HERE, Row, footer, of, worked
from _studies.study import Study
from _train import scenes
from _train.child import prepared

from splatmill.backplane import keys
from splatmill.backplane.redis_program import find
from splatmill.schema import Event, JobState, StateEvent, TrainOptions

ARMS = ("without", "unwatched", "watched")
CACHE = HERE.parent / "build" / "bench"
JOB = "bench000000live0"


def main(argv: list[str]) -> int:
    if argv[:1] == ["--run"]:  # a process of `_rounds`
        return _measure(json.loads(argv[1]))
    return STUDY.main(argv)


def _rounds(asked: argparse.Namespace) -> Iterator[Row]:
    scene = scenes.named(asked.scene, asked.work)
    ready = prepared(scene, asked.work)
    if "failure" in ready:
        raise SystemExit(ready["failure"])
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder, _redis(Path(folder)) as address:
        for number in range(asked.rounds):
            for arm in (*ARMS[number % 3 :], *ARMS[: number % 3]):
                answer = Path(folder) / "answer.json"
                job = {
                    "arm": arm,
                    "redis": address,
                    "capture": str(scene.folder),
                    "sfm": str((asked.work / scene.name / "sfm").resolve()),
                    "options": scene.options | {"steps": asked.steps, "seed": 0},
                    "answer": str(answer),
                }
                with _onlooker(address, arm == "watched") as fetched:
                    subprocess.run([*_command(), "--run", json.dumps(job)], check=True)
                row = json.loads(answer.read_text())
                row |= {"bench": "live", "scene": scene.name, "asked_steps": asked.steps, "round": number}
                yield row | {"fetched": len(fetched), "fetched_bytes": sum(fetched)}


def _command() -> list[str]:
    return [sys.executable, "-m", "splatmill_worker", "bench", "live"]


def _measure(job: Row) -> int:
    """One run, in this process."""
    from splatmill_worker import pipeline
    from splatmill_worker.__main__ import return_freed_memory
    from splatmill_worker.service.attempts.attempt import Attempt
    from splatmill_worker.service.attempts.live_view import LiveView
    from splatmill_worker.service.lock import JobLock

    return_freed_memory()
    marks: dict[str, tuple[float, float, float]] = {}
    snapshots = 0

    def emit(event: Event) -> None:
        nonlocal snapshots
        snapshots += event.type == "snapshot"
        if event.type == "plan":
            marks["begin"] = time.perf_counter(), time.process_time(), worked()
        elif isinstance(event, StateEvent) and event.state is JobState.exporting:
            marks["end"] = time.perf_counter(), time.process_time(), worked()

    connection = redis.Redis(unix_socket_path=job["redis"])
    view = None
    if job["arm"] != "without":
        view = LiveView(Attempt(connection, JOB, 1, 1, JobLock(connection, JOB, "bench")), emit)
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        workdir = Path(folder)
        (workdir / "sfm").symlink_to(job["sfm"])
        options = TrainOptions.model_validate(job["options"])
        outcome = pipeline.run(Path(job["capture"]), workdir, options, emit, lambda: False, onlookers=view)
        report = json.loads((outcome.out / "report.json").read_text())
    own = _cpu_of("live view")
    if view is not None:
        view.close()
    begin, end = marks["begin"], marks["end"]
    cpu = end[1] - begin[1]
    row = {
        "arm": job["arm"],
        "seconds": end[0] - begin[0],
        "cpu_seconds": cpu,
        "others_cpu_seconds": max(0.0, end[2] - begin[2] - cpu),
        "train_seconds": report["seconds"]["train"],
        "live_seconds": report["seconds"].get("live", 0.0),
        "thread_cpu_seconds": own,
        "steps": report["result"]["steps"],
        "gaussians": report["result"]["gaussians"],
        "psnr": report["result"]["psnr"],
        "snapshots": snapshots,
    }
    Path(job["answer"]).write_text(json.dumps(row))
    return 0


def _cpu_of(name: str) -> float:
    """CPU seconds of the threads of this process with this name, to 10 ms."""
    ids = {thread.native_id for thread in threading.enumerate() if thread.name == name}
    return float(sum(row.user_time + row.system_time for row in psutil.Process().threads() if row.id in ids))


@contextmanager
def _redis(folder: Path) -> Iterator[str]:
    """A Redis of our own; yields the path of its socket."""
    path = folder / "redis.sock"
    place = ["--unixsocket", str(path), "--dir", str(folder)]
    quiet = ["--port", "0", "--save", "", *place, "--loglevel", "warning"]
    with subprocess.Popen([find().path, *quiet], stdout=subprocess.DEVNULL) as server:
        try:
            while not path.exists():
                time.sleep(0.02)
            yield str(path)
        finally:
            server.terminate()


@contextmanager
def _onlooker(address: str, watches: bool) -> Iterator[list[int]]:
    """Somebody who looks, if `watches`, and fetches each snapshot; yields the sizes of those fetched."""
    sizes: list[int] = []
    over = threading.Event()

    def look() -> None:
        connection, last = redis.Redis(unix_socket_path=address), None
        while not over.wait(0.25):
            connection.set(keys.watched(JOB), b"1", ex=20)
            tag = connection.hget(keys.snapshot(JOB), "tag")
            if tag is not None and tag != last:
                last = tag
                sizes.append(connection.hstrlen(keys.snapshot(JOB), "ply"))
                connection.hget(keys.snapshot(JOB), "ply")
        connection.delete(keys.watched(JOB), keys.snapshot(JOB))

    if not watches:
        yield sizes
        return
    looker = threading.Thread(target=look)
    looker.start()
    try:
        yield sizes
    finally:
        over.set()
        looker.join()


def table(rows: list[Row]) -> str:
    """The medians, by scene and number of steps."""
    lines = []
    for scene, steps in dict.fromkeys((row["scene"], row["asked_steps"]) for row in rows):
        by_arm = {arm: of(rows, scene=scene, asked_steps=steps, arm=arm) for arm in ARMS}
        for arm, mine in by_arm.items():
            if not mine or not by_arm["without"]:
                continue
            cells: list[object] = []
            for name in ("seconds", "cpu_seconds"):
                own, base = (
                    statistics.median(row[name] for row in some) for some in (mine, by_arm["without"])
                )
                cells.append(f"{own:.2f} ({100 * (own / base - 1):+.1f} %)")
            cells.append(f"{statistics.median(row['snapshots'] for row in mine):g}")
            for name, whole in (("live_seconds", "seconds"), ("thread_cpu_seconds", "cpu_seconds")):
                cells.append(f"{100 * statistics.median(row[name] / row[whole] for row in mine):.2f} %")
            lines.append([scene, steps, arm, len(mine), *cells])
    return _page.table(
        "scene|steps|live view|rounds|seconds|CPU seconds|snapshots|training waited|thread", lines
    )


def others(rows: list[Row]) -> str:
    cores = statistics.median(row["others_cpu_seconds"] / row["seconds"] for row in rows)
    return f"Meanwhile other programs used {cores:.1f} cores (median), Redis and the onlooker included."


STUDY = Study(
    name="live",
    about=__doc__,
    cases={"rounds": _rounds},
    key=("scene", "asked_steps", "arm", "round"),
    blocks={"medians": table, "others": others, "footer": footer},
    figures={},
    options={
        "scene": {"default": "synthetic", "help": "a scene of bench train, or the folder of a capture"},
        "steps": {"type": int, "default": 1500},
        "rounds": {"type": int, "default": 5},
        "work": {"type": Path, "default": CACHE, "help": "where photos and recovered cameras are kept"},
    },
)

"""One plan in a folder that several processes share: the time with one, two and four, and the model after disturbances.

    splatmill bench workers                          # a still life in four tiles: some ten minutes
    splatmill bench workers --steps 300 --workers 1 2 --disturbed 1 --dry

Each row is a plan whose cameras are known, done by processes of `splatmill unit` that share the cores of the machine.
In a disturbed row one of two processes is killed at a random moment and started again a second later, one is frozen in
a tile until its claim has lapsed and is then continued, and a third one joins late. The model must have the bytes of
that of the first plan which was done with as many threads and which nobody disturbed.

Expected before it was measured: on two cores no wall time is gained, as one process uses both, and some is lost while
all but one process wait for the coarse model and for the last unit. With machines of their own for four processes, the
longest chain of units is at most 0.4 of all units in turn.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import _page
from _page import Column
from _rows import Row, footer
from _studies.study import Study

from splatmill.schema import TrainOptions
from splatmill_worker.synthetic import capture as still_life
from splatmill_worker.tiles.folder import CLAIM_SECONDS, PlanFolder, digest_of, facts_of
from splatmill_worker.tiles.units import ScenePlan
from workers.process import Worker

LATE = 8.0
"""Seconds after which a process joins that joins late."""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of each number of processes, then the disturbed ones."""
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-", dir=options.work) as name:
        folder = Path(name)
        still_life(folder / "capture")
        asked = TrainOptions(
            steps=options.steps,
            image_size=options.image_size,
            holdout=8,
            seed=options.seed,
            tiles=options.tiles,
        )
        scene = ScenePlan(digest_of(folder / "capture"), asked)
        first = copied(folder, scene, "first", None)
        cameras = Worker(first.root, options.cores)
        while "cameras" not in first.states() and cameras.runs:
            time.sleep(0.1)
        cameras.send(signal.SIGKILL)
        cameras.wait()
        known = first.ended()["cameras"].path
        assert known is not None
        row: Row = {
            "bench": "workers", "tiles": options.tiles, "steps": options.steps, "seed": options.seed,
            "image_size": options.image_size,
        }  # fmt: skip
        first_with: dict[int, str] = {}
        for count in options.workers:
            plan = copied(folder, scene, f"{count}", known)
            workers, seconds = together(plan, count, max(1, options.cores // count))
            if "scene" not in plan.states():
                yield f"{count} processes did not finish the scene: {workers[0].lines[-1]}"
                return
            digest = first_with.setdefault(workers[0].threads, model_of(plan))
            yield row | {"workers": count, "disturbed": None} | outcome(plan, workers, seconds, digest)
        for seed in range(options.disturbed):
            plan = copied(folder, scene, f"disturbed-{seed}", known)
            workers, seconds, events = disturbed(plan, random.Random(seed), max(1, options.cores // 2))
            fields = outcome(plan, workers, seconds, first_with.get(workers[0].threads))
            yield row | {"workers": 2, "disturbed": seed, "events": events} | fields


def copied(folder: Path, scene: ScenePlan, name: str, cameras: Path | None) -> PlanFolder:
    """A folder with the plan, and with the output of the unit `cameras` where it is known."""
    plan = PlanFolder(folder / name, scene)
    plan.save()
    plan.place(folder / "capture")
    if cameras is not None:
        shutil.copytree(cameras, plan.output("cameras"))
    return plan


def together(plan: PlanFolder, count: int, threads: int) -> tuple[list[Worker], float]:
    """The processes that have done the plan, begun at once, and their wall seconds."""
    began = time.perf_counter()
    workers = [Worker(plan.root, threads) for _ in range(count)]
    with ending(workers):
        for worker in workers:
            worker.wait()
    return workers, time.perf_counter() - began


@contextmanager
def ending(workers: list[Worker]) -> Iterator[None]:
    """Kill the processes that still run at the end of the block."""
    try:
        yield
    finally:
        for worker in workers:
            worker.send(signal.SIGKILL)


def disturbed(plan: PlanFolder, chance: random.Random, threads: int) -> tuple[list[Worker], float, list[str]]:
    """As `together` with two processes, and what happened to them."""
    began = time.perf_counter()
    victim, frozen = Worker(plan.root, threads), Worker(plan.root, threads)
    workers, events = [victim, frozen], list[str]()

    def note(event: str) -> None:
        events.append(f"{time.perf_counter() - began:.1f} s: {event}")

    with ending(workers):
        time.sleep(LATE)
        workers.append(Worker(plan.root, threads))
        note("a third one joins")
        while frozen.runs and not in_tile(frozen):
            time.sleep(0.05)
        time.sleep(chance.uniform(0.0, 1.0))
        frozen.send(signal.SIGSTOP)
        note(f"the second one is frozen in {last_of(frozen)}")
        time.sleep(chance.uniform(0.0, 4.0))
        victim.send(signal.SIGKILL)
        note(f"the first one is killed in {last_of(victim)}")
        victim.wait()
        time.sleep(1.0)
        workers.append(Worker(plan.root, threads))
        note("it is started again")
        time.sleep(CLAIM_SECONDS + 2.0)
        frozen.send(signal.SIGCONT)
        note("the second one is continued")
        for worker in workers:
            worker.wait()
    return workers, time.perf_counter() - began, events


def in_tile(worker: Worker) -> bool:
    return bool(worker.begun) and worker.begun[-1][0].startswith("tile")


def last_of(worker: Worker) -> str:
    return worker.begun[-1][0] if worker.begun and worker.runs else "no unit"


def model_of(plan: PlanFolder) -> str:
    """A digest of the model's file."""
    scene = plan.ended()["scene"].path
    assert scene is not None
    return hashlib.sha256((scene / "model.ply").read_bytes()).hexdigest()


def outcome(plan: PlanFolder, workers: Sequence[Worker], seconds: float, digest: str | None) -> Row:
    """The fields of a plan that is done. digest: that of the model of the first plan with as many threads that
    nobody disturbed; None without one.
    """
    ended = {name: end.path for name, end in plan.ended().items() if end.path is not None}
    units = {name: float(facts_of(path)["seconds"]) for name, path in ended.items() if name != "cameras"}
    begun = Counter(name for worker in workers for name, _ in worker.begun)
    busy = [sum(units[name] for name, _ in worker.begun) for worker in workers]
    longest = sum(max(units[name] for name in units if name.startswith(kind)) for kind in ("tile", "seam"))
    return {
        "threads": workers[0].threads,
        "seconds": round(seconds, 1),
        "idle": [round(max(0.0, 1.0 - each / seconds), 3) for each in busy],
        "units": units,
        "in_turn": round(sum(units.values()), 1),
        "chain": round(units["coarse"] + longest + units["scene"], 1),
        "again": {name: count for name, count in begun.items() if count > 1},
        "outputs": len([path for path in (plan.root / "units").iterdir() if path.is_dir()]),
        "same": None if digest is None else model_of(plan) == digest,
    }


COLUMNS: tuple[Column, ...] = (
    (
        "processes:",
        lambda row: str(row["workers"]) if row["disturbed"] is None else "2, disturbed, and a third",
    ),
    ("threads each:", "{threads}"),
    ("wall seconds:", "{seconds:.0f}"),
    ("units in turn:", lambda row: f"{row['in_turn']:.0f} s"),
    ("longest chain:", lambda row: f"{row['chain']:.0f} s"),
    ("idle", lambda row: ", ".join(f"{100 * share:.0f}%" for share in row["idle"])),
    ("begun again", lambda row: ", ".join(row["again"]) or "none"),
    ("same bytes", lambda row: {True: "yes", False: "NO", None: "not compared"}[row["same"]]),
)


def table(rows: list[Row]) -> str:
    """A row for each plan."""
    return _page.of_rows(COLUMNS, rows)


def events(rows: list[Row]) -> str:
    """What happened in the disturbed rows."""
    return "\n".join(
        f"- Disturbed, {number}: {'; '.join(row['events'])}."
        for number, row in enumerate((row for row in rows if row["disturbed"] is not None), 1)
    )


def conclusion(rows: list[Row]) -> str:
    """Whether all models are alike, and what four machines would take."""
    alone = next(row for row in rows if row["workers"] == 1 and row["disturbed"] is None)
    alike = sum(row["same"] is True for row in rows)
    disturbed = sum(row["disturbed"] is not None for row in rows)
    return (
        f"{alike} of {len(rows)} models have the bytes of the first one with as many threads; {disturbed} of them were "
        f"disturbed. One process takes {alone['seconds']:.0f} s. Where every unit has what one process has here, the "
        f"longest chain of units takes {alone['chain']:.0f} s, {alone['chain'] / alone['in_turn']:.2f} of all units in "
        "turn."
    )


def made(rows: list[Row]) -> str:
    row = rows[0]
    return (
        f"Made by `splatmill bench workers` with {row['steps']} steps, photos of {row['image_size']} pixels, "
        f"{row['tiles']} tiles, seed {row['seed']}, without the cameras.\n{footer(rows)}"
    )


STUDY = Study(
    name="workers",
    about=__doc__,
    cases={"workers": measured},
    key=("workers", "disturbed", "tiles", "steps", "image_size", "seed"),
    order=lambda row: (row["disturbed"] is not None, row["workers"], row["disturbed"]),
    blocks={"conclusion": conclusion, "table": table, "events": events, "footer": made},
    figures={},
    home=Path(__file__).resolve().parent,
    options={
        "workers": {"nargs": "+", "type": int, "default": [1, 2, 4], "help": "numbers of processes"},
        "disturbed": {"type": int, "default": 3, "help": "plans that are disturbed"},
        "tiles": {"type": int, "default": 4},
        "steps": {"type": int, "default": 3000},
        "image-size": {"type": int, "default": 480},
        "seed": {"type": int, "default": 0},
        "cores": {"type": int, "default": len(os.sched_getaffinity(0)), "help": "that the processes share"},
        "work": {"type": Path, "help": "folder for the plans while they are done"},
    },
)
main = STUDY.main

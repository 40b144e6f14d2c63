"""The programs `plan`, `unit` and `units`: make a plan of a scene in tiles, do its units, and list them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from splatmill.schema import (
    Event,
    LogEvent,
    ProgressEvent,
    ProgressVideo,
    Switch,
    TrainOptions,
    format_duration,
)
from splatmill.schema.quantities import listed
from splatmill_worker.errors import Cancelled, Refusal, WorkerError
from splatmill_worker.tiles.folder import SCENE, Claimed, PlanFolder, digest_of, facts_of
from splatmill_worker.tiles.units import ScenePlan

REFUSED, FAILED, UNWRITABLE, STOPPED, CLAIMED = 5, 3, 1, 130, 75
"""Exit statuses, those of the command line: the plan or its photos cannot be used; a unit failed; a folder could not be
written; Ctrl-C; another process runs the unit."""

MOST_TILES = 1024

POLL_SECONDS = 2.0
"""Time between two looks for units, while other processes run those that the next ones need."""

MOST_CRASHES = 3
"""Times that a unit's process may be killed before the unit counts as failed."""

LINE_SECONDS = 5.0
"""Time between two lines of progress."""


def make_plan(root: Path, options: str, tiles: int) -> int:
    """Write the plan of the capture in `root`, with TrainOptions as JSON; returns the exit status."""
    return _reported(lambda: _make_plan(root, TrainOptions.model_validate_json(options), tiles))


def do_unit(root: Path, name: str | None) -> int:
    """Do the unit `name`, or all that can be done until none is left; returns the exit status."""
    return _reported(lambda: _do_all(root) if name is None else _do_one(root, name))


def list_units(root: Path, *, as_json: bool) -> int:
    """Print the units of the plan in `root` and their states; returns the exit status."""

    def show() -> int:
        rows = _rows(PlanFolder.open(root))
        print(json.dumps(rows, indent=1) if as_json else _table(rows))
        return 0

    return _reported(show)


def _reported(run: Callable[[], int]) -> int:
    """The exit status of `run`, with its errors printed as sentences."""
    try:
        return run()
    except Refusal as refusal:
        print(f"Error: {refusal}", file=sys.stderr)
        return REFUSED
    except WorkerError as failure:
        print(f"Error: {failure}", file=sys.stderr)
        return FAILED
    except BrokenPipeError:  # `splatmill units DIR | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"Error: {error.filename or 'the folder'}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except (KeyboardInterrupt, Cancelled):
        print("Stopped; units that were done are kept.", file=sys.stderr)
        return STOPPED


def _make_plan(root: Path, options: TrainOptions, tiles: int) -> int:
    _check(options, tiles)
    folder = PlanFolder(root, ScenePlan(digest_of(root / "capture"), options, tiles))
    folder.save()
    kept = [name for name, ended in folder.ended().items() if ended.state == "done"]
    print(f"{len(folder.plan.units)} units: {listed([unit.name for unit in folder.plan.units], 4)}")
    if kept:
        print(f"done already: {listed(kept, 8)}")
    print(f"Do them, on any machine that sees {root}: splatmill unit {root}")
    return 0


def _check(options: TrainOptions, tiles: int) -> None:
    """Raise Refusal for what units do not do."""
    if not 2 <= tiles <= MOST_TILES:
        raise Refusal(
            "option_out_of_range",
            f"tiles is {tiles}; a scene is divided into 2 to {MOST_TILES} tiles.",
            advice="Train a scene in one piece with splatmill train.",
        )
    given = {
        "time_budget": options.time_budget is not None,
        "within": options.within is not None,
        "progress_video": options.progress_video is not ProgressVideo.off,
        "time_lapse": options.time_lapse is Switch.on,
        "start": options.start is not None,
    }
    for name in (name for name, is_given in given.items() if is_given):
        raise Refusal(
            "option_out_of_range",
            f"The option {name} is for a training in one piece: the units of a plan run on several machines, each to "
            "the end of its steps.",
            advice=f"Leave out {name}; preset and steps say how long each unit trains.",
        )


def _do_one(root: Path, name: str) -> int:
    """Do one unit in this process."""
    from splatmill_worker.tiles.stages import Context, run_unit

    folder = PlanFolder.open(root)
    try:
        folder.plan.unit(name)
    except KeyError:
        names = listed([unit.name for unit in folder.plan.units], 8)
        raise Refusal(
            "option_out_of_range", f"The plan has no unit {name!r}.", advice=f"Its units are {names}."
        ) from None
    ended = folder.ended().get(name)
    if ended is not None and ended.state == "done":
        print(f"{name} is done already.")
        return 0
    missing = folder.plan.missing(name, folder.states())
    if missing:
        raise Refusal(
            "option_out_of_range",
            f"{name} needs {listed(missing, 6)} first.",
            advice=f"splatmill unit {root} does all units in their order.",
        )
    folder.forget_failure(name)
    stopped = _StopSignals()
    try:
        with folder.claimed(name) as run:
            try:
                run_unit(Context(folder, run, _Lines(name), lambda: stopped.asked or not run.held()))
            except Cancelled:
                if stopped.asked:
                    raise
                raise Claimed from None
            except WorkerError as failure:
                run.fail(failure.message, failure.advice or "")
                raise
    except Claimed:
        print(f"{name} is run by {folder.running(name) or 'another process'}.", file=sys.stderr)
        return CLAIMED
    if name == "scene":
        _link_scene(folder)
    return 0


def _do_all(root: Path) -> int:
    """Do units, each in a process of its own, until the scene is done or nothing can be done any more."""
    folder = PlanFolder.open(root)
    stopped = _StopSignals()
    crashes: dict[str, int] = {}
    while True:
        folder = PlanFolder.open(root)
        states = folder.states()
        if "scene" in states:
            break
        ready = folder.plan.ready(states)
        if not ready:
            break
        free = [name for name in ready if folder.running(name) is None]
        if not free:
            time.sleep(POLL_SECONDS)
        for name in free[:1]:
            status = _in_process(root, name, stopped)
            if stopped.asked:
                raise KeyboardInterrupt
            if status < 0:
                crashes[name] = crashes.get(name, 0) + 1
                if crashes[name] >= MOST_CRASHES:
                    _give_up(folder, name, -status)
            elif status not in (0, FAILED, REFUSED, CLAIMED):
                return status
        if stopped.asked:
            raise KeyboardInterrupt
    print(_table(_rows(folder)))
    scene = folder.ended().get("scene")
    if scene is None or scene.path is None:
        return FAILED
    print(root / SCENE / "model.ply")
    return 0


def _in_process(root: Path, name: str, stopped: _StopSignals) -> int:
    """Do one unit in a process of its own, which gives all memory back; its exit status, negative for a signal."""
    child = subprocess.Popen([sys.executable, "-m", "splatmill_worker", "unit", str(root), name])
    while True:
        try:
            return child.wait(timeout=POLL_SECONDS)
        except subprocess.TimeoutExpired:
            if stopped.asked:
                child.send_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            stopped.asked = True


def _give_up(folder: PlanFolder, name: str, number: int) -> None:
    """Record that the process of a unit was killed too often."""
    message = f"The process of {name} was ended {MOST_CRASHES} times by signal {number}" + (
        " (out of memory, most often)." if number == signal.SIGKILL else "."
    )
    try:
        with folder.claimed(name) as run:
            run.fail(
                message,
                "Use more tiles, a smaller image_size or fewer max_gaussians, or a machine with more memory.",
            )
    except Claimed:
        return


def _link_scene(folder: PlanFolder) -> None:
    """Let `scene` in the folder of the plan be the output of the last unit."""
    path = folder.ended()["scene"].path
    assert path is not None
    link = folder.root / SCENE
    new = folder.root / f".{SCENE}.{path.name}"
    new.unlink(missing_ok=True)
    new.symlink_to(path.relative_to(folder.root), target_is_directory=True)
    new.replace(link)


def _rows(folder: PlanFolder) -> list[dict[str, Any]]:
    ended, states = folder.ended(), folder.states()
    rows = []
    for unit in folder.plan.units:
        row: dict[str, Any] = {"unit": unit.name}
        end = ended.get(unit.name)
        if end is not None and end.path is not None:
            facts = facts_of(end.path)
            row |= {"state": "done", "folder": str(end.path)} | {
                name: facts[name] for name in ("seconds", "gaussians", "photos", "psnr") if name in facts
            }
        elif end is not None:
            row |= {"state": "failed", "why": f"{end.failure} {end.advice}".strip()}
        elif missing := folder.plan.missing(unit.name, states):
            row |= {"state": "waiting", "why": f"needs {listed(missing, 3)}"}
        elif (by := folder.running(unit.name)) is not None:
            row |= {"state": "running", "why": by}
        else:
            row |= {"state": "ready"}
        rows.append(row)
    return rows


def _table(rows: list[dict[str, Any]]) -> str:
    lines = []
    for row in rows:
        parts = [f"{row['unit']:<10} {row['state']:<8}"]
        if "seconds" in row:
            parts.append(format_duration(row["seconds"]))
        if "photos" in row:
            parts.append(f"{row['photos']} photos")
        if "gaussians" in row:
            parts.append(f"{row['gaussians']:,} Gaussians")
        if row.get("psnr") is not None:
            parts.append(f"{row['psnr']:.2f} dB")
        if "why" in row:
            parts.append(row["why"])
        lines.append("  ".join(parts))
    return "\n".join(lines)


class _Lines:
    """Prints the events of a unit as lines: warnings at once, progress every LINE_SECONDS."""

    def __init__(self, name: str) -> None:
        self._name, self._last = name, time.monotonic()

    def __call__(self, event: Event) -> None:
        if isinstance(event, LogEvent):
            print(f"{self._name}: {event.message}", flush=True)
        elif isinstance(event, ProgressEvent) and time.monotonic() - self._last >= LINE_SECONDS:
            self._last = time.monotonic()
            of = "" if event.total is None else f" of {event.total}"
            left = "" if event.eta is None else f", {format_duration(event.eta)} left"
            print(f"{self._name}: {event.stage} {event.done}{of}{left}", flush=True)


class _StopSignals:
    """Whether SIGTERM or Ctrl-C asked to stop."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

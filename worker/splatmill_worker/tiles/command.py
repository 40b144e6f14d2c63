"""The programs `plan`, `unit` and `units`: make a plan of a scene in tiles, do its units, and list them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from splatmill.schema import (
    Event,
    LogEvent,
    ProgressEvent,
    TrainOptions,
    format_duration,
)
from splatmill.schema.quantities import listed
from splatmill_worker.errors import Cancelled, Refusal, WorkerError
from splatmill_worker.memory import return_freed
from splatmill_worker.tiles.folder import SCENE, Claimed, PlanFolder, digest_of, facts_of
from splatmill_worker.tiles.retrying import may_pass
from splatmill_worker.tiles.units import ScenePlan

REFUSED, FAILED, UNWRITABLE, STOPPED, CLAIMED, BROKEN = 5, 3, 1, 130, 75, 70
"""Exit statuses, those of the command line: the plan or its photos cannot be used; a unit failed; a folder could not be
written; Ctrl-C; another process runs the unit; a unit ended in a way that another attempt may not."""

ENDED = "ended_decoders.json"
"""File in a work folder that names the photos which end the process that decodes them."""

POLL_SECONDS = 2.0
"""Time between two looks for units, while other processes run those that the next ones need."""

MOST_ATTEMPTS = 3
"""Attempts at a unit by one process, of which none published and none recorded a failure, after which it counts as
failed."""

SIGNAL_SECONDS = 0.1
"""Time after which a request to stop reaches the process of a unit."""

LINE_SECONDS = 5.0
"""Time between two lines of progress."""


def make_plan(root: Path, capture: Path, options: str) -> int:
    """Write the plan of the folder `capture`, which is moved into `root`; returns the exit status.

    options: TrainOptions with tiles, as JSON. Where the plan is refused, `capture` is removed, and an earlier plan
        stays as it is.
    """
    try:
        return _reported(lambda: _make_plan(root, capture, TrainOptions.model_validate_json(options)))
    finally:
        shutil.rmtree(capture, ignore_errors=True)


def do_units(root: Path, names: Sequence[str], begun: int | None = None) -> int:
    """Do the units `names` one after the other, or all that can be done until none is left; returns the exit status.

    Of several, those are left out that other processes do or have done, or that need what these do. The status is that
    of the unit with which it ends early, or the first that is not 0.

    begun: descriptor of a file to which the name of each unit is written when it begins, a line each. The process that
        reads it has begun this one, which ends with it.
    """
    if not names:
        return _reported(lambda: _do_all(root))
    first, stopped, parent = 0, _StopSignals(), os.getppid()
    for name in names:
        status = _reported(partial(_do_one, root, name, stopped, begun, alone=len(names) == 1), UNWRITABLE)
        if status in (UNWRITABLE, STOPPED, BROKEN):
            return status
        if stopped.asked or (begun is not None and os.getppid() != parent):
            return STOPPED
        first = first or status
        return_freed()
    return first


def list_units(root: Path, *, as_json: bool) -> int:
    """Print the units of the plan in `root` and their states; returns the exit status."""

    def show() -> int:
        rows = _rows(PlanFolder.open(root))
        print(json.dumps(rows, indent=1) if as_json else _table(rows))
        return 0

    return _reported(show)


def _reported(run: Callable[[], int], unread: int = 0) -> int:
    """The exit status of `run`, with its errors printed as sentences. unread: where nobody reads what is printed."""
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
        return unread
    except OSError as error:
        print(f"Error: {error.filename or 'the folder'}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except (KeyboardInterrupt, Cancelled):
        print("Stopped; units that were done are kept.", file=sys.stderr)
        return STOPPED


def _make_plan(root: Path, capture: Path, options: TrainOptions) -> int:
    folder = PlanFolder(root, ScenePlan(digest_of(capture), options))
    if not folder.capture.exists():
        folder.capture.parent.mkdir(parents=True, exist_ok=True)
        capture.rename(folder.capture)
    folder.save()
    folder.forget_failures(*(unit.name for unit in folder.plan.units))
    left_out = _left_out(folder)
    kept = [name for name, ended in folder.ended().items() if ended.state == "done" and name not in left_out]
    print(f"{len(folder.plan.units)} units: {listed([unit.name for unit in folder.plan.units], 4)}")
    if kept:
        print(f"done already: {listed(kept, 8)}")
    print(f"Do them, on any machine that sees {root}: splatmill unit {root}")
    return 0


def _do_one(root: Path, name: str, stopped: _StopSignals, begun: int | None, *, alone: bool) -> int:
    """Do one unit in this process. alone: it was asked for, so that what is in its way is an error."""
    folder = PlanFolder.open(root)
    try:
        folder.plan.unit(name)
    except KeyError:
        names = listed([unit.name for unit in folder.plan.units], 8)
        raise Refusal(
            "option_out_of_range", f"The plan has no unit {name!r}.", advice=f"Its units are {names}."
        ) from None
    if not alone and _is_taken(folder, name):
        return 0
    if _is_done(folder, name):
        return 0
    missing = folder.plan.missing(name, folder.states())
    if missing and not alone:
        return 0  # another process does them
    if missing:
        raise Refusal(
            "option_out_of_range",
            f"{name} needs {listed(missing, 6)} first.",
            advice=f"splatmill unit {root} does all units in their order.",
        )
    if folder.states().get(name) == "failed":
        states = folder.states()
        without = [unit.name for unit in folder.plan.units if name in unit.optional]
        for other, by in ((other, folder.running(other, states)) for other in without):
            if by is not None:
                print(f"{other} is made without {name} by {by}; try again when it is done.", file=sys.stderr)
                return CLAIMED
        folder.forget_failures(name)
    try:
        with folder.claimed(name) as run:
            if _is_done(folder, name):  # by a process that was faster
                return 0
            # Short units end before their first line of progress, and libraries take seconds to be loaded.
            print(f"{name}: begins", flush=True)
            if begun is not None:
                os.write(begun, f"{name}\n".encode())
            from splatmill_worker.images.decoding import decoders
            from splatmill_worker.tiles.stages import Context, run_unit

            try:
                context = Context(folder, run, _Lines(name), lambda: stopped.asked or not run.held())
                readable = [path.resolve() for path in (folder.capture, run.path.parent, run.work)]
                with decoders.confined(readable, run.work / ENDED, context.cancelled):
                    run_unit(context)
            except Exception as error:
                if stopped.asked:
                    raise Cancelled from error
                if not run.owned():
                    raise Claimed from error
                if isinstance(error, WorkerError) and not may_pass(error):
                    run.fail(error.message, error.advice or "")
                    raise
                if isinstance(error, WorkerError):
                    print(
                        f"Error: {error} Another machine may do {name}, or this one later.", file=sys.stderr
                    )
                else:
                    traceback.print_exc()
                return BROKEN
            if name == "scene":
                _link_scene(folder.root, run.path)
    except Claimed:
        print(f"{name} is run by {folder.running(name) or 'another process'}.", file=sys.stderr)
        return CLAIMED
    return 0


def _is_taken(folder: PlanFolder, name: str) -> bool:
    """Whether the unit has ended, or another process runs it."""
    states = folder.states()
    return name in states or folder.running(name, states) is not None


def _is_done(folder: PlanFolder, name: str) -> bool:
    """Whether the unit is done, which is printed; the scene is linked then."""
    ended = folder.ended().get(name)
    if ended is None or ended.path is None:
        return False
    if name == "scene":
        _link_scene(folder.root, ended.path)
    print(f"{name} is done already.")
    return True


def _do_all(root: Path) -> int:
    """Do units until the scene is done or nothing can be done any more, all that are ready in one process of theirs."""
    folder = PlanFolder.open(root)
    stopped = _StopSignals()
    attempts: dict[str, int] = {}
    while True:
        folder = PlanFolder.open(root)
        states = folder.states()
        if "scene" in states:
            break
        ready = folder.plan.ready(states)
        if not ready:
            break
        free = [name for name in ready if folder.running(name, states) is None]
        if not free:
            time.sleep(POLL_SECONDS)
        else:
            if free[0] in folder.plan.camera_names:  # short ones, for which one process is started
                pending = folder.plan.pending(states)
                free = [name for name in folder.plan.camera_names if name in pending]
            status, last = _in_process(root, free, stopped)
            if stopped.asked:
                raise KeyboardInterrupt
            if status == UNWRITABLE:
                return status
            after = folder.states()
            stuck = after == states and folder.running(last, after) is None
            if last not in after and (status < 0 or status == BROKEN or stuck):
                attempts[last] = attempts.get(last, 0) + 1
                if attempts[last] >= MOST_ATTEMPTS:
                    _give_up(folder, last, status)
        if stopped.asked:
            raise KeyboardInterrupt
    print(_table(_rows(folder)))
    scene = folder.ended().get("scene")
    if scene is None or scene.path is None:
        return FAILED
    _link_scene(root, scene.path)
    print(root / SCENE / "model.ply")
    return 0


def _in_process(root: Path, names: Sequence[str], stopped: _StopSignals) -> tuple[int, str]:
    """Do units in a process of their own, which gives all memory back; its exit status, negative for a signal, and the
    unit that began last.
    """
    with tempfile.TemporaryFile() as begun:
        child = subprocess.Popen(
            [
                *(sys.executable, "-m", "splatmill_worker", "unit", "--begun", str(begun.fileno())),
                *("--", str(root), *names),
            ],
            pass_fds=[begun.fileno()],
        )
        while True:
            try:
                status = child.wait(timeout=SIGNAL_SECONDS)
                break
            except subprocess.TimeoutExpired:
                if stopped.asked:
                    child.send_signal(signal.SIGTERM)
        begun.seek(0)
        return status, [names[0], *begun.read().decode().split()][-1]


def _give_up(folder: PlanFolder, name: str, status: int) -> None:
    """Record that a unit was tried too often. status: of its last process, negative for a signal."""
    if status == -signal.SIGKILL:
        ended = "its process was killed, most often because memory ran out"
        advice = "Use more tiles, a smaller image_size or fewer max_gaussians, or a machine with more memory."
    else:
        ended = f"its process ended with status {status}" if status else "its process ended without doing it"
        advice = f"splatmill unit {folder.root} {name} does it alone, and shows why."
    with suppress(Claimed), folder.claimed(name) as run:
        if name not in folder.states():
            run.fail(f"{name} was tried {MOST_ATTEMPTS} times, and {ended}.", advice)


def _link_scene(root: Path, path: Path) -> None:
    """Let `scene` in the folder of the plan be the output of the last unit, which lies at `path`."""
    new = root / f".{SCENE}.{os.getpid()}"
    new.unlink(missing_ok=True)
    new.symlink_to(path.relative_to(root), target_is_directory=True)
    new.replace(root / SCENE)


def _left_out(folder: PlanFolder) -> set[str]:
    """The units that the scene does not need: those before the cameras, where these are given or there already, and
    mapping units without a cluster."""
    ended, states = folder.ended(), folder.states()
    photos = ended.get("photos")
    names = {unit.name for unit in folder.plan.units} - folder.plan.pending(states) - set(ended)
    if photos is not None and photos.path is not None:
        names |= folder.plan.left_out(facts_of(photos.path))
    return names


def _rows(folder: PlanFolder) -> list[dict[str, Any]]:
    ended, states, left_out = folder.ended(), folder.states(), _left_out(folder)
    rows = []
    for unit in folder.plan.units:
        row: dict[str, Any] = {"unit": unit.name}
        end = ended.get(unit.name)
        if unit.name in left_out:
            row |= {"state": "left out"}
        elif end is not None and end.path is not None:
            facts = facts_of(end.path)
            row |= {"state": "done", "folder": str(end.path)} | {
                name: facts[name] for name in ("seconds", "gaussians", "photos", "psnr") if name in facts
            }
        elif end is not None:
            row |= {"state": "failed", "why": f"{end.failure} {end.advice}".strip()}
        elif missing := folder.plan.missing(unit.name, states):
            row |= {"state": "waiting", "why": f"needs {listed(missing, 3)}"}
        elif (by := folder.running(unit.name, states)) is not None:
            row |= {"state": "running", "why": by}
        else:
            row |= {"state": "ready"}
        rows.append(row)
    return rows


def _table(rows: list[dict[str, Any]]) -> str:
    lines = []
    for row in [row for row in rows if row["state"] != "left out"]:
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

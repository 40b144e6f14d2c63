"""A job whose scene is trained in tiles: all units of its plan, of which other processes may do the tiles."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from splatmill.schema import (
    CamerasEvent,
    Event,
    JobState,
    LogEvent,
    PreviewEvent,
    ProgressEvent,
    StateEvent,
    TrainOptions,
    UnitEvent,
)
from splatmill.schema.quantities import listed
from splatmill_worker.errors import Cancelled, TrainingFailed, WorkerError
from splatmill_worker.memory import return_freed
from splatmill_worker.pipeline.events import Emit
from splatmill_worker.pipeline.job import check_lpips, choose_kernels
from splatmill_worker.pipeline.live import Looks, Onlookers
from splatmill_worker.pipeline.stages import Outcome
from splatmill_worker.sfm.run import SFM
from splatmill_worker.tiles.camera_parts import has_parts
from splatmill_worker.tiles.folder import TILES, Ended, PlanFolder, digest_of, facts_of
from splatmill_worker.tiles.live import LiveTiles
from splatmill_worker.tiles.remaining import Remaining
from splatmill_worker.tiles.retrying import may_pass
from splatmill_worker.tiles.stages import CHECKPOINTS, PLAN_FILE, Context, run_unit
from splatmill_worker.tiles.units import ScenePlan

WAIT_SECONDS = 1.0
"""Time between two looks for the tiles that other processes do, while nothing is left for this one."""

STAGES = {"features": "features", "matches": "matching", "mapping": "mapping"}
"""Stages of the progress of a job while other processes do its last units of a kind; of other kinds, it is `tiles`."""


UNIT_FACTS = ("seconds", "photos", "gaussians")
"""Facts of a unit that its event has."""


class Others(Protocol):
    """Processes that do tiles beside the one that has the job."""

    def begin(self, folder: PlanFolder) -> None:
        """Let others find the plan, and bring what was done by earlier attempts into its folder."""

    def stored(self, output: Path) -> None:
        """Let others, and later attempts, find the output of a unit."""

    def offer(self, tiles: Sequence[str]) -> None:
        """Let others do these tiles. Those that were offered before stay as they are."""

    def take_back(self, tile: str) -> bool:
        """Take a tile that was offered; returns whether no other does it now."""

    def gather(self, folder: PlanFolder) -> None:
        """Bring the outputs of others into the folder of the plan."""

    def forget(self, outputs: Sequence[Path]) -> None:
        """Let others have outputs of units no longer, as no unit needs them."""

    def end(self) -> None:
        """Take back all that nobody has begun."""


class Nobody:
    """No other process does tiles."""

    def begin(self, folder: PlanFolder) -> None:
        """Do nothing."""

    def stored(self, output: Path) -> None:
        """Do nothing."""

    def offer(self, tiles: Sequence[str]) -> None:
        """Do nothing."""

    def take_back(self, tile: str) -> bool:
        """Nobody has it."""
        return True

    def gather(self, folder: PlanFolder) -> None:
        """Do nothing."""

    def forget(self, outputs: Sequence[Path]) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""


@dataclass(frozen=True)
class _Work:
    """What all units of a job are done with.

    entered: the states that the job has entered.
    left_out: names of units that have nothing to do, once `photos` has ended.
    checked: units of which that is known.
    reported: the last state that was emitted of each unit.
    """

    folder: PlanFolder
    workdir: Path
    emit: Emit
    cancelled: Callable[[], bool]
    looks: Looks | None
    live: LiveTiles | None
    others: Others
    entered: list[JobState] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    reported: dict[str, str] = field(default_factory=dict)

    def report(
        self, name: str, state: Literal["running", "elsewhere", "done", "failed"], output: Path | None = None
    ) -> None:
        """Emit the state of a unit, unless that was the last one, or it has nothing to do.

        output: folder of one that is done, for its facts.
        """
        if self.reported.get(name) == state or name in self.left_out:
            return
        self.reported[name] = state
        facts: dict[str, Any] = {} if output is None else facts_of(output)
        facts = {key: value for key, value in facts.items() if key in UNIT_FACTS}
        self.emit(UnitEvent(unit=name, state=state, tiles=self.folder.plan.tiles, **facts))


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Emit,
    cancelled: Callable[[], bool],
    *,
    onlookers: Onlookers | None = None,
    others: Others | None = None,
) -> Outcome:
    """Train a scene in as many tiles as `options` say, and leave in `workdir/out` what `pipeline.run` leaves.

    The arguments are those of `pipeline.run`. others: processes that do tiles as well; None: there are none.

    What has been done is used again by a run in the same folder. A tile that fails is replaced by the coarse model, as
    the report says. Raises Refusal, SfmFailed and TrainingFailed (see `errors`).
    """
    plan = ScenePlan(digest_of(capture), options)
    folder = PlanFolder(workdir / TILES, plan)
    looks = None if onlookers is None else Looks(onlookers)
    live = None if looks is None else LiveTiles(looks, folder)
    work = _Work(folder, workdir, emit, cancelled, looks, live, others or Nobody())
    choose_kernels(options)
    check_lpips(options)
    folder.save()
    folder.place(capture)
    folder.release()
    folder.forget_failures(*plan.part_names)
    work.others.begin(folder)
    if "cameras" in folder.states():
        _forget_features(work)  # an attempt may have ended before it did
    try:
        while "scene" not in folder.states():
            _step(work)
    except Cancelled:
        return Outcome("cancelled", workdir / "out")
    finally:
        work.others.end()
    scene = folder.ended()["scene"].path
    assert scene is not None
    shutil.rmtree(workdir / "out", ignore_errors=True)
    shutil.copytree(scene, workdir / "out", copy_function=os.link)
    return Outcome("succeeded", workdir / "out")


def _step(work: _Work) -> None:
    """Do the next unit, or wait for those of others."""
    if work.cancelled():
        raise Cancelled
    folder, others = work.folder, work.others
    ended = folder.ended()
    states = {name: end.state for name, end in ended.items()}
    _check_parts(work, ended)
    for name, end in ended.items():
        work.report(name, end.state, end.path)
    ready = folder.plan.ready(states)
    tiles = [name for name in ready if name in folder.plan.part_names and name not in work.left_out]
    # What failed here is not known elsewhere: the last steps beside a tile that failed are left to this process.
    offered = [name for name in tiles if "failed" not in map(states.get, folder.plan.unit(name).needs)]
    if offered:
        others.offer(offered)
    free = None
    for name in ready:
        if name not in tiles or others.take_back(name):
            free = name
            break
        work.report(name, "elsewhere")
    others.gather(folder)  # what has ended since
    if work.live is not None:
        work.live.look()
    if free is None:
        _wait(work, tiles)
    elif free not in folder.states():
        _do(work, free)


def _check_parts(work: _Work, ended: Mapping[str, Ended]) -> None:
    """Note which units have nothing to do, once the photos are examined."""
    photos = ended.get("photos")
    if photos is None or photos.path is None or "photos" in work.checked:
        return
    work.checked.append("photos")
    plan = work.folder.plan
    if has_parts(photos.path, work.folder.capture, work.workdir, plan.options):
        work.left_out.extend(plan.left_out(facts_of(photos.path)))
    else:
        work.left_out.extend(plan.camera_names[1:-1])


def _do(work: _Work, name: str) -> None:
    """Do a unit. The failure of a tile is recorded; that of another unit is raised."""
    folder = work.folder
    state = JobState.exporting if name == "scene" else JobState.training
    if name in folder.plan.camera_names:
        state = JobState.sfm
    if state not in work.entered:
        work.entered.append(state)
        work.emit(StateEvent(state=state))
    work.report(name, "running")
    with folder.claimed(name) as run:
        context = Context(
            folder,
            run,
            _Events(work, name, run.work),
            work.cancelled,
            work.looks,
            work.live,
            work.workdir / SFM,
            work.workdir if name == "coarse" else None,
        )
        try:
            run_unit(context)
        except WorkerError as error:
            # Memory that a tile lacks here would be lacking again: no other worker is left to train it.
            passes = may_pass(error) and not isinstance(error, TrainingFailed)
            if name not in folder.plan.part_names or passes:
                raise
            run.fail(error.message, error.advice or "")
            work.emit(LogEvent(level="warning", message=f"{name} failed: {error}"))
            work.report(name, "failed")
            return
    return_freed()
    work.report(name, "done", run.path)
    if name != "scene" and name not in work.left_out:
        work.others.stored(run.path)
    if name == "cameras":
        if (run.path / SFM).is_dir():
            # Where the service looks for cameras that other jobs on the capture can use; given ones have none.
            shutil.copytree(run.path / SFM, work.workdir / SFM, copy_function=_link, dirs_exist_ok=True)
        _forget_features(work)
        work.others.stored(run.path)  # for which there may have been no room before
    elif name == "coarse":
        shutil.rmtree(work.workdir / CHECKPOINTS, ignore_errors=True)
        work.workdir.joinpath(PLAN_FILE).unlink(missing_ok=True)
    elif name in folder.plan.tile_names + folder.plan.seam_names:
        facts = facts_of(run.path)
        if facts["photos"]:
            message = f"{name} is trained: {facts['gaussians']:,} Gaussians, {facts['photos']} photos."
            work.emit(LogEvent(message=message))


def _forget_features(work: _Work) -> None:
    """Remove what only the cameras needed: features of 1,000 photos and their matches take 0.2 GB or more."""
    folder = work.folder
    outputs = [folder.output(name) for name in folder.plan.camera_names[1:-1]]
    if "pairs" not in work.left_out:
        work.others.forget(outputs)
    for path in outputs:
        if path.is_dir():
            part = path.with_name(f".{path.name}.part")  # which the next attempt removes
            path.rename(part)
            shutil.rmtree(part)


def _wait(work: _Work, parts: Sequence[str]) -> None:
    """Wait for units that other processes do."""
    plan, states = work.folder.plan, work.folder.states()
    kind = parts[0].partition("-")[0]
    alike = {
        "features": plan.feature_names,
        "matches": plan.match_names,
        "mapping": [name for name in plan.mapping_names if name not in work.left_out],
    }.get(kind, plan.tile_names + plan.seam_names)
    work.emit(
        ProgressEvent(
            stage=STAGES.get(kind, "tiles"),
            done=sum(name in states for name in alike),
            total=len(alike),
            note=f"waiting for {listed(parts, 4)}, which other workers do",
        )
    )
    time.sleep(WAIT_SECONDS)


class _Events:
    """Emits the events of a unit as those of the job: the time that is left is that of all tiles."""

    def __init__(self, work: _Work, name: str, folder: Path) -> None:
        self._work, self._name, self._folder = work, name, folder
        plan = work.folder.plan
        several = plan.blocks if name in plan.camera_names else plan.tiles
        if name in plan.mapping_names:
            several -= len(set(plan.mapping_names).intersection(work.left_out))
        self._label = {"coarse": "coarse model", "scene": "whole scene"}.get(
            name, f"{name.replace('-', ' ')} of {several}"
        )
        self._began = time.monotonic()
        self._remaining: Remaining | None = None
        if name in work.folder.plan.tile_names + work.folder.plan.seam_names:
            ended = work.folder.ended().items()
            seconds = {
                unit: None if end.path is None else facts_of(end.path)["seconds"] for unit, end in ended
            }
            self._remaining = Remaining.of(work.folder.plan, seconds, name)

    def __call__(self, event: Event) -> None:
        if isinstance(event, PreviewEvent | CamerasEvent):
            path = (self._folder / event.path).relative_to(self._work.workdir)
            event = event.model_copy(update={"path": path.as_posix()})
        elif isinstance(event, ProgressEvent) and self._name not in ("photos", "pairs", "cameras"):
            note = self._label if event.note is None else f"{self._label}: {event.note}"
            eta = event.eta
            if self._remaining is not None and eta is not None:
                eta = round(self._remaining.seconds(time.monotonic() - self._began, eta), 1)
            event = event.model_copy(update={"note": note, "eta": eta})
        self._work.emit(event)


def _link(source: str, target: str) -> None:
    with suppress(FileExistsError):
        os.link(source, target)

"""The scene that the tiles of a plan make together: its Gaussians, what they show, and its files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatmill_worker.pipeline.cameras import Cameras, recover_cameras
from splatmill_worker.pipeline.events import TrainingEvents
from splatmill_worker.pipeline.files import write_files
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.training import Recording
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score, evaluate
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lpips import Distances
from splatmill_worker.splat.machine import resident_memory
from splatmill_worker.splat.plan.evaluated import finally_evaluated
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report.report import PlannedScene
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.train.renderer import evaluation_background, renderer
from splatmill_worker.tiles.coarse_model import Coarse, read_gaussians
from splatmill_worker.tiles.seams import Seams


@dataclass(frozen=True)
class TrainedTile:
    """How the training of a tile ended.

    path: folder of its output; None where it failed.
    steps, seconds: of its training, in all units.
    failure: the sentence that it failed with, from the beginning or before its last steps.
    """

    path: Path | None
    steps: int = 0
    seconds: float = 0.0
    failure: str = ""


@dataclass(frozen=True)
class Joining:
    """What the scene is made of.

    job: the unit as a job, with the options of the coarse training.
    stages: its clocks.
    coarse: the coarse model, with a cell for each tile.
    tiles: the trained tiles, in the order of the cells.
    facts: that the coarse training published.
    """

    job: Job
    stages: Stages
    coarse: Coarse
    tiles: tuple[TrainedTile, ...]
    facts: dict[str, Any]

    @property
    def steps(self) -> int:
        """Training steps of all units."""
        return int(self.facts["steps"]) + sum(tile.steps for tile in self.tiles)

    @property
    def seconds(self) -> float:
        """Training seconds of all units, as long as one process takes for them."""
        return float(self.facts["train_seconds"]) + sum(tile.seconds for tile in self.tiles)

    @property
    def failures(self) -> list[str]:
        """A sentence for each tile that failed, in whole or in its last steps."""
        return [
            f"Tile {number} of {len(self.tiles)} failed, so that its place shows the coarse model: {tile.failure}"
            if tile.path is None
            else f"Tile {number} of {len(self.tiles)} lacks its last steps, so that its seams may show: {tile.failure}"
            for number, tile in enumerate(self.tiles, 1)
            if tile.failure
        ]

    def gaussians(self) -> Gaussians:
        """Those of all cells."""
        return joined(self.coarse, [tile.path for tile in self.tiles])


def joined(coarse: Coarse, tiles: Sequence[Path | None]) -> Gaussians:
    """The Gaussians of every cell: of the output of its tile, or of the coarse model where there is none. The far ones
    come last.
    """
    means = coarse.gaussians.means.double().numpy()
    return concatenate(
        *(
            coarse.gaussians.select(torch.from_numpy(cell.holds(means)) & ~coarse.far)
            if path is None
            else read_gaussians(path)
            for cell, path in zip(coarse.cells, tiles, strict=True)
        ),
        coarse.gaussians.select(coarse.far),
    )


def write_scene(joining: Joining) -> dict[str, Any]:
    """Write the files that a training of the whole scene writes; returns figures by name."""
    job, stages, coarse = joining.job, joining.stages, joining.coarse
    cameras = known_cameras(job, stages)
    engine = open_engine(joining.gaussians(), job.kernels)
    events = TrainingEvents(job.emit, job.workdir, coarse.plan, (coarse.held_out or coarse.views)[0])
    trained = _trained(joining, engine, events)
    for sentence in joining.failures:
        events.warn(sentence)
    scene = PlannedScene(cameras.scene, coarse.facts, _stated(joining), coarse.held_out)
    write_files(job, cameras, scene, engine, trained, Recording(events, None, None), stages)
    held_out = trained.held_out
    return {
        "gaussians": engine.count,
        "steps": trained.steps,
        "train_seconds": round(trained.seconds, 2),
        "psnr": None if held_out is None else held_out.psnr,
        "ssim": None if held_out is None else held_out.ssim,
        "failed": [number for number, tile in enumerate(joining.tiles, 1) if tile.path is None],
        "seams": _seams(coarse, engine, events),
    }


def known_cameras(job: Job, stages: Stages) -> Cameras:
    """The cameras that the unit `cameras` has found. What there is to be said of them was said there, and shown."""
    return recover_cameras(replace(job, emit=lambda event: None, looks=None), stages)


def _stated(joining: Joining) -> Plan:
    """The plan as the report has it: that of the coarse training, with the number of Gaussians of the whole."""
    plan, count = joining.coarse.plan, len(joining.tiles)
    because = (
        f"The scene is trained in {count} tiles, after a coarse model of {joining.coarse.gaussians.count} Gaussians. "
        f"All tiles together may have about {joining.coarse.most}."
    )
    reasons = {**plan.reasons, "max_gaussians": because}
    if "growth" in reasons:
        growth = "The photos differ in their light, which late Gaussians would learn: tiles add "
        growth += "none." if not joining.coarse.limited else "some, as a limit stopped the coarse training."
        reasons["growth"] = growth
    return replace(plan, max_gaussians=joining.coarse.most, kernels=joining.job.kernels, reasons=reasons)


def _trained(joining: Joining, engine: Engine, events: TrainingEvents) -> Trained:
    """The scene as the result of one training, whose curve is that of the coarse training and a last point."""
    plan = joining.coarse.plan
    with joining.stages.measured("evaluate"):
        held_out, on_training = _scores(joining.coarse, engine, events)
    curve = tuple(CurvePoint(**point) for point in joining.facts["curve"])
    last = CurvePoint(
        seconds=joining.seconds,
        step=joining.steps,
        loss=curve[-1].loss if curve else math.nan,
        psnr=None if held_out is None else held_out.psnr,
        ssim=None if held_out is None else held_out.ssim,
        gaussians=engine.count,
        memory=resident_memory(),
        train_psnr=on_training.psnr,
        train_ssim=on_training.ssim,
        views=None if held_out is None else len(held_out.views),
    )
    return Trained(
        gaussians=Gaussians(**engine.parameters()).padded(plan.schedule.degree),
        curve=(*curve, last),
        held_out=held_out,
        on_training=on_training,
        steps=joining.steps,
        seconds=joining.seconds,
        evaluate_seconds=joining.stages.seconds["evaluate"],
        stopped=f"{len(joining.tiles)} tiles were trained",
        failure=None,
        recoveries=0,
        views=joining.coarse.views,
        cameras_moved=joining.facts["cameras_moved"],
        disagreements=joining.coarse.disagreements,
    )


def _scores(coarse: Coarse, engine: Engine, events: TrainingEvents) -> tuple[Score | None, Score]:
    plan, views = coarse.plan, coarse.held_out
    render, background = renderer(engine, plan), evaluation_background(plan, coarse.views)
    on_training = evaluate(render, finally_evaluated(coarse.views), background)
    if not views:
        return None, on_training
    done = iter(range(1, len(views) + 1))
    distances = Distances.read() if plan.lpips else None
    return (
        evaluate(render, views, background, distances, lambda: events.evaluating(next(done), len(views))),
        on_training,
    )


def _seams(coarse: Coarse, engine: Engine, events: TrainingEvents) -> dict[str, Any] | None:
    """How the held-out photos are shown where two tiles meet; None without such photos or with one tile."""
    if not coarse.held_out or len(coarse.cells) < 2:
        return None
    means = coarse.gaussians.means.double().numpy()
    near = ~coarse.far
    members: list[Tensor] = [torch.from_numpy(cell.holds(means)) & near for cell in coarse.cells]
    seams = Seams(coarse.gaussians, members, coarse.plan)
    note = "views compared where tiles meet"
    return asdict(
        seams.measured(engine, coarse.held_out, lambda done, total: events.evaluating(done, total, note))
    )

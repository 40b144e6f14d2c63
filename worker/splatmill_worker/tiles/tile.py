"""Trains one tile: the Gaussians in and next to its cell, with those of the rest as a fixed context.

That is done in two units. The first starts from the coarse model; the second takes the last steps, beside the tiles
that were trained around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from splatmill.schema import LogEvent, ProgressEvent
from splatmill_worker import memory
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.photos import Room
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.training import EXTENT
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.photos import BYTES_PER_PIXEL, fit_in_memory, statistics_memory
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import boost_of
from splatmill_worker.splat.plan.schedule import MANY_VISITS
from splatmill_worker.splat.train.loop import Hooks, train
from splatmill_worker.splat.train.observers import Observer, TrainingProgress
from splatmill_worker.splat.views import TrainingView
from splatmill_worker.tiles.coarse_model import Coarse
from splatmill_worker.tiles.visibility import parts

MARGIN = 0.05
"""Width of what is trained around a cell and then left to the tiles beside it, over the longest side of the box that
holds four fifths of the coarse model."""

COARSE_SHARE = 0.5
"""Share of the steps of a whole run that the coarse training takes. A tile uses each of its photos as often as the
other steps of a whole run would."""

LAST = 0.2
"""Share of the steps of a tile that are taken beside the trained tiles around it (decisions: seams)."""


@dataclass(frozen=True)
class Tile:
    """A tile to train.

    job: the unit as a job.
    coarse: the coarse model.
    number: of the cell, from 0.
    scene: reads the Gaussians that its training starts from, of all cells, and which of them are far, bool [N]: these
        stay as they are (see `coarse_model.far`).
    last: this and the tiles around it are trained, but for the last steps.
    observers: of its training.
    """

    job: Job
    coarse: Coarse
    number: int
    scene: Callable[[], tuple[Gaussians, Tensor]]
    last: bool = False
    observers: Sequence[Observer] = ()


@dataclass(frozen=True)
class TileResult:
    """A trained tile.

    gaussians: the trained ones within its cell, in the training world.
    facts: figures by name.
    """

    gaussians: Gaussians
    facts: dict[str, Any]


def train_tile(tile: Tile, stages: Stages) -> TileResult:
    """Train the Gaussians of a tile, on the parts of the photos that show them. Where no photo does, they stay as they
    are. Raises TrainingFailed, and Cancelled.
    """
    coarse = tile.coarse
    cell = coarse.cells[tile.number]
    whole, far = tile.scene()
    means = whole.means.double().numpy()
    core = torch.from_numpy(cell.holds(means)) & ~far
    free = torch.from_numpy(cell.holds(means, _margin(coarse.gaussians))) & ~far
    with stages.measured("load"):
        views = list(_views(tile, whole, core))
        memory.return_freed()
    within = whole.select(core)
    if not views or not within.count:
        return TileResult(within, {"gaussians": within.count, "steps": 0, "photos": len(views)})
    plan = tile_plan(coarse, int(free.sum()), len(views), last=tile.last)
    photo_bytes = BYTES_PER_PIXEL * sum(view.full.camera.width * view.full.camera.height for view in views)
    engine = open_engine(
        whole.select(free),
        plan.kernels,
        clustered=plan.cluster_culling,
        context=whole.select(~free),
        most_kept=statistics_memory(plan.max_memory, photo_bytes),
    )
    del whole, far, means, within  # the engine has its own

    def progress(progress: TrainingProgress) -> None:
        tile.job.emit(
            ProgressEvent(stage="training", done=progress.step, total=progress.steps, eta=progress.eta)
        )

    trained = train(
        engine,
        views,
        [],
        plan,
        extent=EXTENT,
        hooks=Hooks(
            progress=progress,
            warn=lambda sentence: tile.job.emit(LogEvent(level="warning", message=sentence)),
            cancelled=tile.job.cancelled,
            observers=tile.observers,
            compares=False,
        ),
    )
    if trained.failure is not None:
        raise trained.failure
    stages.add("train", trained.seconds)
    gaussians = trained.gaussians.padded(3)
    kept = gaussians.select(torch.from_numpy(cell.holds(gaussians.means.double().numpy())))
    return TileResult(
        kept,
        {
            "gaussians": kept.count,
            "steps": trained.steps,
            "photos": len(views),
            "train_seconds": round(trained.seconds, 2),
            "train_psnr": round(trained.on_training.psnr, 3),
        },
    )


def _margin(gaussians: Gaussians) -> float:
    low, high = torch.quantile(_some(gaussians.means.double()), torch.tensor([0.1, 0.9]).double(), dim=0)
    return MARGIN * float((high - low).max())


def _some(rows: Tensor, limit: int = 100_000) -> Tensor:
    """An even choice of at most `limit` rows: torch's quantiles take no more than 16 million numbers."""
    return rows[:: max(1, math.ceil(len(rows) / limit))]


def tile_plan(coarse: Coarse, free: int, photos: int, *, last: bool = False) -> Plan:
    """The plan of a tile of `free` Gaussians that so many photos show: that of the coarse model, from a model on.

    last: of its last steps, in which no Gaussians are added.

    Each photo that shows the tile is used as often as by the steps that the coarse training leaves, and two steps are
    taken at least. So a Gaussian gets about as many steps as in one piece, however many tiles there are (decisions:
    tile-steps). No photo is set aside: the coarse model has been trained on all of them, so that they could judge no
    more. Instead, where both trainings together use a photo more than MANY_VISITS times, a tile takes only the last
    part of the fall of the rates, MANY_VISITS over that number: what so many steps learn at high rates is rather the
    photos than the scene (decisions: tile-rates).

    Gaussians are added up to the share of both trainings after which one piece adds none: later ones learn what single
    photos show. A tile of fewer than some hundred steps adds none by then, and none does where that share ends with the
    coarse training. Where a limit stopped the coarse training from adding more, they are added up to that share of the
    tile's own steps (decisions: tile-growth).
    """
    plan, schedule = coarse.plan, coarse.plan.schedule
    until, boost = 1.0 - LAST, schedule.annealing.boost
    share = photos / len(coarse.views)
    total = max(2, round(share * coarse.steps * (1.0 - COARSE_SHARE) / COARSE_SHARE))
    first = max(1, min(total - 1, round(until * total)))
    steps = total - first if last else first
    earlier = coarse.steps / max(1, len(coarse.views))
    skipped = max(0.0, 1.0 - MANY_VISITS / (earlier + total / photos))
    begin, end = (until, 1.0) if last else (0.0, until)
    assert boost is not None
    annealing = replace(
        schedule.annealing,
        boost=min(boost, boost_of(max(1, coarse.steps))),
        begin=skipped + (1.0 - skipped) * begin,
        end=skipped + (1.0 - skipped) * end,
    )
    most, densify_until = free, schedule.densify_until
    if not last and (plan.densify or "densify" not in plan.forced):
        most = max(free, math.ceil(coarse.most * free / max(1, coarse.gaussians.count)))
    if not coarse.limited:
        densify_until = max(0.0, (densify_until - COARSE_SHARE) / (1.0 - COARSE_SHARE))
    return replace(
        plan,
        kernels="cpu" if plan.kernels == "gpu" else plan.kernels,
        max_gaussians=most,
        densify=most > free,
        initial="model",
        far_shell=False,
        gaps=False,
        pose_refinement=False,
        validation=None,
        stops_when_flat=False,
        target_psnr=None,
        lpips=False,
        schedule=replace(
            schedule.seen_by(share, total),
            budget=Budget(steps=steps),
            expected_steps=steps,
            longest=None,
            resolution=((0, 1),),
            densify_until=min(1.0, densify_until / until),
            annealing=annealing,
            earlier_visits=earlier + (first / photos if last else 0.0),
        ),
    )


def _views(tile: Tile, whole: Gaussians, members: Tensor) -> Iterator[TrainingView]:
    """The parts of the training photos that show the members, bool [N], of the scene `whole`, in files where memory is
    too small for them.
    """
    coarse, room = tile.coarse, Room.of(tile.job)
    cameras = [view.full.camera for view in coarse.views]
    pairs = []
    for view, part in zip(
        coarse.views, parts(whole, members, cameras, antialias=coarse.plan.antialias), strict=True
    ):
        stop_if(tile.job.cancelled)
        if part is not None and bool(part.counted_of(view).any()):
            pairs.append((view, part))
    taken = BYTES_PER_PIXEL * sum(part.pixels for _, part in pairs)
    files = None if fit_in_memory(taken, room.memory) else PixelFiles(room.folder)
    for done, (view, part) in enumerate(pairs, 1):
        stop_if(tile.job.cancelled)
        shown = part.of(view)
        yield shown if files is None else shown.placed(files)
        tile.job.emit(ProgressEvent(stage="loading", done=done, total=len(pairs)))

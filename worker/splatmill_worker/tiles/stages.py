"""What each unit of a plan does: cameras and what they follow from, the coarse model, a tile, its last steps, and the
scene that all make."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatmill.files import replacing
from splatmill.schema import Backend, PlanEvent, Switch, TrainOptions
from splatmill_worker.images.load import training_size
from splatmill_worker.pipeline.cameras import Cameras, recover_cameras
from splatmill_worker.pipeline.events import Emit, progress_events
from splatmill_worker.pipeline.first_gaussians import seeded
from splatmill_worker.pipeline.job import Job, choose_kernels
from splatmill_worker.pipeline.live import Looks
from splatmill_worker.pipeline.planning import plan_training, planned_photos
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.training import train_scene
from splatmill_worker.sfm import blocks
from splatmill_worker.sfm.effort import SCORES
from splatmill_worker.sfm.run import SFM
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.capacity import resolved
from splatmill_worker.splat.plan.photos import loading_size, statistics_memory
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.tiles import camera_parts, coarse_model, joined
from splatmill_worker.tiles.cells import divide
from splatmill_worker.tiles.folder import PlanFolder, Run, facts_of
from splatmill_worker.tiles.live import LiveTiles
from splatmill_worker.tiles.tile import COARSE_SHARE, Tile, train_tile
from splatmill_worker.tiles.units import ScenePlan, seam_name, tile_name, tile_number

CHECKPOINTS, PLAN_FILE = "checkpoints", "plan.json"
"""The folder of the checkpoints and the file of the plan of a training, in its work folder."""


@dataclass(frozen=True)
class Context:
    """What units are run with.

    folder: the plan.
    run: the unit that this process holds.
    emit: called with each event.
    cancelled: polled; the unit ends with Cancelled when it returns true.
    looks: those of onlookers, who see cameras and the coarse model, and whose seconds the report has; None where there
        are none.
    live: shows them the tiles; None where there are none.
    known: folder of cameras that were recovered before, from which the unit `cameras` begins; None without.
    kept: folder for the plan and the checkpoints of the unit, from which another run of it continues; None: they go
        with the run.
    """

    folder: PlanFolder
    run: Run
    emit: Emit
    cancelled: Callable[[], bool]
    looks: Looks | None = None
    live: LiveTiles | None = None
    known: Path | None = None
    kept: Path | None = None

    def job(self, options: TrainOptions) -> Job:
        """A job in the work folder of the unit, which has the recovered cameras there are; those of tiles need none.

        The coarse model alone is trained by the kernels of the options; the others run on machines with a GPU and
        without. Raises Refusal where those kernels do not run here.
        """
        work = self.run.work
        work.joinpath("out").mkdir(exist_ok=True)
        ended = self.folder.ended()
        if self.run.name in ("photos", "cameras", "coarse", "scene"):
            cameras = ended.get("cameras")
            known = self.known if cameras is None or cameras.path is None else cameras.path / SFM
            if known is not None and known.is_dir():
                shutil.copytree(known, work / SFM, dirs_exist_ok=True)
        prepared = None
        if "photos" in self.folder.plan.unit(self.run.name).needs:
            prepared = camera_parts.stored_photos(self.output("photos"), self.folder.capture)
        if self.kept is not None:
            checkpoints, plan = self.kept / CHECKPOINTS, self.kept / PLAN_FILE
            checkpoints.mkdir(exist_ok=True)
            work.joinpath(CHECKPOINTS).symlink_to(checkpoints, target_is_directory=True)
            if plan.is_file():
                shutil.copyfile(plan, work / PLAN_FILE)
        kernels: Kernels = "reference" if options.backend is Backend.reference else "cpu"
        if self.run.name == "coarse":
            kernels = choose_kernels(options)
        looks = self.looks if self.run.name in ("cameras", "coarse", "scene") else None
        options = options.model_copy(update={"time_lapse": Switch.off})
        return Job(self.folder.capture, work, options, kernels, self.emit, self.cancelled, looks, prepared)

    def outputs(self, *units: str) -> list[Path]:
        """The folders of the outputs of those of the units that are done."""
        ended = self.folder.ended()
        return [path for unit in units if (path := ended[unit].path) is not None]

    def output(self, unit: str) -> Path:
        """The folder of the output of a unit that is done."""
        path = self.folder.ended()[unit].path
        assert path is not None
        return path


def run_unit(context: Context) -> None:
    """Do the unit that `context` holds, and publish its output. The caller confines decoders.

    Raises Cancelled, and WorkerError.
    """
    name, started = context.run.name, time.perf_counter()
    stages = Stages(context.run.work / "stages.json")
    if name == "cameras":
        facts = _cameras(context, stages)
    elif name in context.folder.plan.camera_names:
        facts = _before_cameras(context)
    elif name == "coarse":
        facts = _coarse(context, stages)
    elif name == "scene":
        facts = joined.write_scene(_joining(context, stages))
    else:
        facts = _tile(context, stages)
    context.run.publish({"seconds": round(time.perf_counter() - started, 1), **facts})


def _before_cameras(context: Context) -> dict[str, Any]:
    plan, name, out = context.folder.plan, context.run.name, context.run.out
    job = context.job(plan.options)
    shutil.rmtree(out)
    out.mkdir()
    if name == "photos":
        return camera_parts.examine_photos(job, out)
    known = None if context.known is None else context.known.parent
    before = context.outputs(*plan.unit(name).needs)
    if name in plan.left_out(facts_of(before[0])):
        return {}
    return camera_parts.do_part(job, name, plan.blocks, before, out, known)


def _cameras(context: Context, stages: Stages) -> dict[str, Any]:
    job = context.job(context.folder.plan.options)
    parts = context.outputs(*context.folder.plan.unit("cameras").needs)
    report = progress_events(job.emit)
    blocks.merge(
        parts, job.workdir, lambda done, total: report("matching", done, total, blocks.MERGING), job.cancelled
    )
    cameras = recover_cameras(job, stages)
    folder = job.workdir / SFM
    shutil.rmtree(context.run.out)  # what recovering leaves there is not for others
    for model in sorted(folder.glob("*/model-*")):
        shutil.copytree(model, context.run.out / model.relative_to(job.workdir))
    for points in sorted(folder.rglob("*.npz")):  # triangulated, and of stereo
        target = context.run.out / points.relative_to(job.workdir)
        if points.name != SCORES and not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(points, target)
    return {"photos": len(cameras.training), "held_out": len(cameras.held_out)}


def _coarse(context: Context, stages: Stages) -> dict[str, Any]:
    plan = context.folder.plan
    job = context.job(plan.options)
    cameras = joined.known_cameras(job, stages)
    most = _most(cameras, job)
    job = replace(job, options=_coarse_options(plan, most))
    planned = plan_training(job, cameras, _shorter, stages)
    if context.kept is not None:
        with replacing(context.kept / PLAN_FILE) as part:
            shutil.copyfile(job.workdir / PLAN_FILE, part)
    decided = planned.plan
    context.emit(PlanEvent(plan=decided.as_dict()))
    photos = planned_photos(job, cameras, planned, stages)
    engine = open_engine(
        seeded(job, planned.first, cameras, photos, decided, planned.seeds),
        decided.kernels,
        clustered=decided.cluster_culling,
        most_kept=statistics_memory(decided.max_memory, photos.size),
    )
    # LPIPS is measured of the whole scene.
    trained, _ = train_scene(
        job,
        cameras,
        photos,
        replace(decided, lpips=False),
        engine,
    )
    if trained.failure is not None:
        raise trained.failure
    shutil.rmtree(context.run.out)
    context.run.out.mkdir()
    near = ~coarse_model.far(trained.gaussians, decided)
    weights = trained.gaussians.logit_opacities[near].double().sigmoid().numpy()
    cells = divide(trained.gaussians.means[near].double().numpy(), weights, plan.tiles)
    coarse_model.Coarse(
        trained.gaussians.padded(3),
        decided,
        tuple(cells),
        most,
        trained.steps,
        tuple(trained.views),
        photos.held_out,
        planned.facts.as_dict(),
        trained.disagreements,
        trained.limited,
        cameras.exported,
    ).write(context.run.out)
    held_out = trained.held_out
    return {
        "gaussians": trained.gaussians.count,
        "steps": trained.steps,
        "train_seconds": round(trained.seconds, 2),
        "psnr": None if held_out is None else held_out.psnr,
        "tiles": len(cells),
        "curve": [asdict(point) for point in trained.curve],
        "cameras_moved": trained.cameras_moved,
    }


def _tile(context: Context, stages: Stages) -> dict[str, Any]:
    name, plan = context.run.name, context.folder.plan
    number, last = tile_number(name), name in plan.seam_names
    job = context.job(plan.options)
    coarse = coarse_model.read(context.output("coarse"))
    context.run.out.mkdir(exist_ok=True)
    if number > len(coarse.cells):
        return {"gaussians": 0, "steps": 0, "photos": 0}  # the coarse model could not be divided further
    ended = context.folder.ended()
    if last and ended[tile_name(number)].path is None:
        return {"gaussians": 0, "steps": 0, "photos": 0}  # the scene has the coarse model there
    own = coarse.cells[number - 1]

    def scene() -> tuple[Gaussians, Tensor]:
        if not last:
            return coarse.gaussians, coarse.far
        # Cells that do not touch this one stay coarse, so that the memory of many tiles is not needed.
        trained = zip(coarse.cells, plan.tile_names, strict=False)
        whole = joined.joined(
            coarse, [ended[tile].path if cell.touches(own) else None for cell, tile in trained]
        )
        return whole, torch.arange(whole.count) >= whole.count - int(coarse.far.sum())

    observers = () if context.live is None else (context.live.of_tile(number - 1),)
    result = train_tile(Tile(job, coarse, number - 1, scene, last, observers), stages)
    shutil.rmtree(context.run.out)
    context.run.out.mkdir()
    coarse_model.write_gaussians(context.run.out, result.gaussians)
    return result.facts


def _joining(context: Context, stages: Stages) -> joined.Joining:
    ended = context.folder.ended()
    coarse = coarse_model.read(context.output("coarse"))
    job = context.job(_coarse_options(context.folder.plan, coarse.most))
    tiles = []
    for number in range(1, len(coarse.cells) + 1):
        tile, seam = ended[tile_name(number)], ended[seam_name(number)]
        facts = [facts_of(unit.path) for unit in (tile, seam) if unit.path is not None]
        tiles.append(
            joined.TrainedTile(
                None if tile.path is None else seam.path or tile.path,
                sum(int(each["steps"]) for each in facts),
                sum(float(each.get("train_seconds", 0.0)) for each in facts),
                tile.failure or seam.failure,
            )
        )
    return joined.Joining(job, stages, coarse, tuple(tiles), facts_of(context.output("coarse")))


def _coarse_options(plan: ScenePlan, most: int) -> TrainOptions:
    """The options of the coarse training, of a scene of at most `most` Gaussians in all.

    The coarse model has at most `most` over the root of the number of tiles, and a tile has beside it at most `most`
    over their number: the more tiles, the less of both.
    """
    return plan.options.model_copy(update={"max_gaussians": max(1, math.ceil(most / math.sqrt(plan.tiles)))})


def _most(cameras: Cameras, job: Job) -> int:
    """The largest number of Gaussians of the whole scene: that of the option, or what its photos resolve."""
    if job.options.max_gaussians is not None:
        return job.options.max_gaussians
    size = loading_size(job.options, job.kernels)
    pixels = [math.prod(training_size(v.camera.width, v.camera.height, size)) for v in cameras.training]
    return resolved(sum(pixels) / max(1, len(pixels)), len(pixels))


def _shorter(plan: Plan) -> Plan:
    """The plan of a whole run with COARSE_SHARE of its steps."""
    schedule = plan.schedule
    budget = schedule.budget
    assert budget.steps is not None

    def share(steps: int) -> int:
        return max(1, round(COARSE_SHARE * steps))

    return replace(
        plan,
        schedule=replace(
            schedule.course(share(schedule.expected_steps), schedule.in_view),
            budget=replace(budget, steps=share(budget.steps)),
            longest=None if schedule.longest is None else share(schedule.longest),
            expected_steps=share(schedule.expected_steps),
            resolution=tuple((share(first) if first else 0, factor) for first, factor in schedule.resolution),
        ),
    )

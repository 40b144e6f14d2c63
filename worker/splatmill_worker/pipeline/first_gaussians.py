"""The Gaussians that training starts from: a given model, or made from points, in a visual hull, or at random."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from splatmill.schema import TrainOptions
from splatmill_worker import memory
from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.pipeline.given_points import points_path, start_path
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.photos import Photos
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.capacity import resolved
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS, sample_frusta
from splatmill_worker.splat.start.given_model import LEAST_ASSESSED, GivenModel, assess, read_given_model
from splatmill_worker.splat.start.hull import Hull, NoHull, at_first, visual_hull
from splatmill_worker.splat.start.points import ENOUGH_POINTS, from_points
from splatmill_worker.splat.start.seeding import Seeds, add_seeds


@dataclass(frozen=True)
class First:
    """The Gaussians that training may start from.

    gaussians: all of them, before the plan limits their number.
    model: the assessment of the given model; None where no model was given.
    hull: the visual hull that points were added in, or why there is none; None where none was carved.
    """

    gaussians: Gaussians
    model: GivenModel | None = None
    hull: Hull | NoHull | None = None


def first_gaussians(job: Job, cameras: Cameras, photos: Photos) -> First:
    """The given model, or Gaussians made from points and in the visual hull of transparent photos, or at random."""
    path = start_model_path(job.capture, job.workdir, job.options)
    if path is not None:
        model = read_given_model(path, cameras.normalization, _most_given(job.options))
        gaussians = model.gaussians
        for note in model.notes:
            job.warn(f"{path.name}: {note}")
        if model.count > gaussians.count:
            job.warn(_reduced_message(path, model.count, gaussians.count))
        start = assess(gaussians, photos.training, antialiased=model.antialiased)
        if start.doubtful:
            job.warn(_doubt_message(start))
        return First(gaussians, start)
    world = cameras.world
    targets = [view.full for view in photos.training]
    hull = None
    if any(target.alpha is not None for target in targets):
        hull = visual_hull(targets, resolved(targets[0].rgb[..., 0].numel(), len(targets)))
    if isinstance(hull, Hull):
        return First(hull.gaussians(len(hull.points), world.points, world.colors), hull=hull)
    if len(world.points) >= ENOUGH_POINTS:
        return First(from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors)), hull=hull)
    return First(from_points(*sample_frusta(targets, RANDOM_GAUSSIANS, job.options.seed)), hull=hull)


def _most_given(options: TrainOptions) -> int:
    """Number of Gaussians of a given model that are kept: as many as memory can train, and as the options ask for."""
    most = Plan.gaussians_within(options.max_memory or memory.available() // 2)
    return most if options.max_gaussians is None else min(most, max(options.max_gaussians, LEAST_ASSESSED))


def _reduced_message(path: Path, count: int, kept: int) -> str:
    return (
        f"{path.name} has {count:,} Gaussians, more than this job can hold. Training starts from the {kept:,} most "
        "opaque ones. Set a larger max_gaussians, or use a machine with more memory, to keep more."
    )


def _doubt_message(start: GivenModel) -> str:
    return (
        f"The given model renders the training photos with a PSNR of {start.psnr:.1f} dB, hardly more than a constant "
        f"colour per photo ({start.one_color:.1f} dB). If the model shows another scene, train without the option "
        "start."
    )


def seeded(
    job: Job, first: First, cameras: Cameras, photos: Photos, plan: Plan, seeds: Seeds | None
) -> Gaussians:
    """The first Gaussians within the plan's limit, with what the plan adds to those made from points.

    seeds: those of `photos`; None: they are found where the plan adds them.
    """
    tell = photos.reporter(job.emit)
    tell("placing the first Gaussians")
    if isinstance(first.hull, Hull):
        added = at_first(len(first.hull.points), plan.max_gaussians)
        gaussians = first.hull.gaussians(added, cameras.world.points, cameras.world.colors)
        return gaussians.most_opaque(plan.max_gaussians)
    gaussians = first.gaussians.most_opaque(plan.max_gaussians)
    if plan.initial != "points":
        return gaussians
    return add_seeds(
        gaussians,
        cameras.world,
        photos.training,
        fill_gaps=plan.gaps,
        add_far_shell=plan.far_shell,
        max_gaussians=plan.max_gaussians,
        seeds=seeds,
        tell=tell,
    )


def start_model_path(capture: Path, workdir: Path, options: TrainOptions) -> Path | None:
    """Return the path of the model file to start from, or None when the training starts from points.

    It is a file among the capture's poses if the option `start` names one, else the stored model that the service has
    copied to `workdir/start.ply`. Raises Refusal when the capture has no such file.
    """
    if options.start is None:
        return None
    if options.start_file is None:
        return workdir / "start.ply"
    return None if points_path(capture, options) is not None else start_path(capture, options)

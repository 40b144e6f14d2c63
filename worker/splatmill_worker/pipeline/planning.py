"""The third stage: what is measured of the photos and of this machine, and the plan that follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from splatmill.schema import Switch
from splatmill_worker.errors import Refusal
from splatmill_worker.kernels.gpu.device import describe
from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.pipeline.first_gaussians import First, first_gaussians
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.photos import Photos, Room, load_photos
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.splat import lpips_weights
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.plan.capacity import resolved
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import Facts, measure
from splatmill_worker.splat.plan.photos import loading_size
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.plan_file import read_plan, write_plan
from splatmill_worker.splat.plan.probe import probe
from splatmill_worker.splat.start.hull import Hull
from splatmill_worker.splat.start.seeding import Seeds

Revise = Callable[[Plan], Plan]


@dataclass(frozen=True)
class Planned:
    """What is known and decided before training.

    first: the Gaussians that it may start from.
    facts: what was measured.
    plan: what was decided.
    photos: at the size of the plan, and in the light that it decides on; None where they are to be loaded smaller.
    room: for them.
    seeds: points that may be added, found in `photos`; None where `photos` are others than those that were measured.
    """

    first: First
    facts: Facts
    plan: Plan
    photos: Photos | None
    room: Room
    seeds: Seeds | None


def plan_training(job: Job, cameras: Cameras, revise: Revise, stages: Stages) -> Planned:
    """Load the photos, measure, and decide.

    Photos of another size than the plan's are freed on return: both sizes at once would be the most memory that photos
    ever take.
    """
    room = Room.of(job)
    with stages.measured("load"):
        photos = load_photos(cameras, loading_size(job.options, job.kernels), room, job.emit)
    with stages.measured("plan"):
        first = first_gaussians(job, cameras, photos)
        facts, seeds = _measure_facts(job, cameras, photos, first)
        if job.options.within is not None:
            facts = replace(facts, seconds_left=job.options.within - stages.elapsed)
        plan = _make_plan(job, facts, revise)
        if (late := overrun(facts, plan)) is not None:
            job.warn(late)
    smaller = plan.image_size < max(facts.width, facts.height)
    trained = None if smaller else _in_light(photos, facts, plan)
    return Planned(first, facts, plan, trained, room, seeds if trained is photos else None)


def overrun(facts: Facts, plan: Plan) -> str | None:
    """A sentence where the training alone takes more than what the job has left of its time; None where it does not."""
    seconds = plan.schedule.budget.seconds
    if facts.seconds_left is None or seconds is None or seconds <= facts.seconds_left:
        return None
    return (
        f"The cameras have left {max(0.0, facts.seconds_left):.0f} s of the time for the whole job. Training takes "
        f"{seconds:.0f} s, to show each photo once, so that the job ends later than asked and its model is blurred. "
        "Give it more time for a sharper one: the cameras are kept."
    )


def planned_photos(job: Job, cameras: Cameras, planned: Planned, stages: Stages) -> Photos:
    """The photos as the plan wants them, loaded anew where it decides on a smaller size."""
    if planned.photos is not None:
        return planned.photos
    with stages.measured("load"):
        return _in_light(
            load_photos(cameras, planned.plan.image_size, planned.room, job.emit),
            planned.facts,
            planned.plan,
        )


def _in_light(photos: Photos, facts: Facts, plan: Plan) -> Photos:
    """The photos, relit if the plan says so."""
    return photos.relit(facts.light) if plan.exposure and facts.light is not None else photos


def _measure_facts(job: Job, cameras: Cameras, photos: Photos, first: First) -> tuple[Facts, Seeds | None]:
    """What can be measured before training: the scene, its photos, how fast this machine trains it; and the seeds."""
    pixels = photos.training[0].full.rgb[..., 0].numel()
    most = resolved(pixels, len(photos.training)) if first.model is None else 0
    speed = probe(open_engine(first.gaussians, job.kernels), photos.training, most=most)
    facts, seeds = measure(
        cameras.world, photos.training, len(photos.held_out), speed, photos.reporter(job.emit)
    )
    facts = replace(facts, start=first.model, photo_bytes=photos.size, photos_on_disk=photos.on_disk)
    if isinstance(first.hull, Hull):
        facts = replace(facts, hull_points=len(first.hull.points))
    elif first.hull is not None:
        facts = replace(facts, no_hull=first.hull.reason)
    if job.options.lpips is not Switch.off:
        facts = replace(facts, no_lpips=lpips_weights.absence())
    card = describe() if job.kernels == "gpu" else None
    return facts if card is None else replace(facts, memory_available=card.free_bytes), seeds


def _make_plan(job: Job, facts: Facts, revise: Revise) -> Plan:
    """The plan that an earlier attempt stored for the same options; else a new one, which is stored.

    Raises Refusal for an option that cannot be followed with this scene or these kernels.
    """
    stored = job.workdir / "plan.json"
    kept = read_plan(stored, job.options)
    if kept is not None:
        return kept
    try:
        plan = revise(decide(facts, job.options, job.kernels))
    except ValueError as error:
        raise Refusal(
            "option_out_of_range", str(error), advice="Change the option and start again."
        ) from error
    # A checkpoint of another plan cannot be resumed.
    for checkpoint in job.checkpoints.iterdir() if job.checkpoints.is_dir() else ():
        checkpoint.unlink()
    write_plan(stored, job.options, plan)
    return plan

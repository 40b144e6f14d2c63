"""How long a job will probably take: a pure function of the request and of what the finished jobs took.

Each stage is scaled from the finished jobs that are most alike; the median is the estimate, the extremes its range.
"""

import math
from collections.abc import Callable, Sequence
from statistics import median

from splatmill.schema import (
    PRESET_LONGEST,
    Backend,
    Estimate,
    EstimateJob,
    StageEstimate,
    TrainOptions,
    preset_steps,
)
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs.finished import Figures

ALIKE = 5
"""Number of finished jobs that a stage is scaled from: enough for a median, few enough to be alike."""

OTHER_PRESET = 1.0
"""Distance between jobs of which one has another preset, or a size of its own: as much as a factor e of photos."""


def estimate(request: EstimateJob, finished: Sequence[Figures]) -> Estimate:
    """Return how long a job would take.

    finished: the figures of finished jobs, newest first. Those of other machines than that of the newest one which
        fits the option `backend` are not used, nor those of other kernels.
    """
    backend = request.options.backend
    fitting = [figures for figures in finished if backend is Backend.auto or figures.kernels == backend.value]
    here = [
        figures
        for figures in fitting
        if (figures.machine, figures.kernels) == (fitting[0].machine, fitting[0].kernels)
    ]
    cameras, rest = _cameras(request, here), _rest(request, here)
    stages = [cameras, _training(request, here, cameras, rest), rest]
    within = request.options.within
    return Estimate(
        seconds=_sum([stage.seconds for stage in stages], within),
        lowest=_sum([stage.lowest for stage in stages], within),
        highest=_sum([stage.highest for stage in stages], within),
        stages=stages,
        jobs=len(here),
        machine=here[0].machine if here else None,
    )


def least_within(request: EstimateJob, finished: Sequence[Figures], *, recovered: bool) -> float | None:
    """Return the seconds of a whole job below which training would not show each photo once, by the fastest of the
    finished jobs that are most alike, or None if none is.

    finished: as for `estimate`.
    recovered: whether the cameras are there from an earlier job.
    """
    once = request.options.model_copy(update={"steps": request.photos, "time_budget": None, "within": None})
    stages = estimate(request.model_copy(update={"options": once}), finished).stages
    return _sum([stage.lowest for stage in stages if not (recovered and stage.stage == "cameras")], None)


def check_time(request: EstimateJob, finished: Sequence[Figures], *, recovered: bool) -> None:
    """Raise a 422 problem if the time for the whole job is too short for so many photos; arguments as above."""
    within = request.options.within
    least = None if within is None else least_within(request, finished, recovered=recovered)
    if within is None or least is None or within >= least:
        return
    why = (
        f"The fastest of the jobs that have finished here and are most alike would take {least:.0f} s for the cameras "
        f"of {request.photos} photos, one step on each, and the files."
    )
    what = f"{why} Give {math.ceil(least)} s or more, or fewer photos."
    raise ProblemError(
        "option_out_of_range",
        f"within is {within:g} s, which is too short. {why}",
        advice=f"Set within to {math.ceil(least)} s or more, or give fewer photos.",
        facts={
            "images": request.photos,
            "errors": [{"where": "options.within", "what": what, "given": f"{within:g}"}],
        },
    )


def _cameras(request: EstimateJob, here: Sequence[Figures]) -> StageEstimate:
    alike = _nearest(
        [figures for figures in here if figures.posed == request.posed],
        lambda figures: _ratio(figures.photos, request.photos),
    )
    kind = "with cameras that came with the photos" if request.posed else "with recovered cameras"
    if not alike:
        return StageEstimate(stage="cameras", because=f"No job {kind} has finished on this server yet.")
    each = [figures.cameras / figures.photos for figures in alike]
    return _stage(
        "cameras",
        [seconds * request.photos for seconds in each],
        f"{_jobs(alike)} {kind} took {_digits(median(each))} s per photo.",
    )


def _training(
    request: EstimateJob, here: Sequence[Figures], cameras: StageEstimate, rest: StageEstimate
) -> StageEstimate:
    options, photos = request.options, request.photos
    trained = max(1, photos - options.held_out_of(photos))
    steps, limit = steps_of(options, trained), options.time_budget or math.inf
    because = f"The time budget is {limit:g} s."
    if options.within is not None:
        if cameras.seconds is None or rest.seconds is None:
            return StageEstimate(stage="training", because=f"It gets what is left of {options.within:g} s.")
        if (left := max(0.0, options.within - cameras.seconds - rest.seconds)) < limit:
            limit, because = left, f"It gets what is left of {options.within:g} s."
    if steps is None:
        return _stage("training", [limit], because)
    alike = _nearest(
        here,
        lambda figures: (
            _ratio(figures.photos, photos)
            + 0.5 * _ratio(figures.steps, steps)
            + _size_distance(figures, options)
        ),
    )
    if not alike and limit < math.inf:
        return _stage("training", [limit], f"{because} The steps may end it earlier.")
    if not alike:
        return StageEstimate(stage="training", because="No such job has finished on this server yet.")
    each = [figures.train / figures.steps * _size_factor(figures, options) for figures in alike]
    longest, may = steps, ""
    if options.doubles(trained):
        longest = PRESET_LONGEST * steps
        may = f", or fewer, or up to {longest} while doubling them gains enough"
    elif options.steps is None and options.start_model is not None:
        may = ", since the given model may have been trained on the photos that would measure what more gains"
    elif options.steps is None:
        may = f", since {trained} training photos are too few to measure what more would gain"
    elif options.target_psnr is not None:
        may = ", at most, since training may end earlier"
    stage = _stage(
        "training",
        [min(limit, seconds * steps) for seconds in each],
        f"{steps} steps{may}; {_jobs(alike)} took {_digits(1000 * median(each))} ms per step.",
    )
    return stage.model_copy(update={"highest": round(min(limit, max(each) * longest), 1)})


def _rest(request: EstimateJob, here: Sequence[Figures]) -> StageEstimate:
    alike = _nearest(here, lambda figures: _ratio(figures.photos, request.photos))
    if not alike:
        return StageEstimate(stage="rest", because="No job has finished on this server yet.")
    return _stage(
        "rest",
        [figures.fixed + figures.by_photo / figures.photos * request.photos for figures in alike],
        f"{_jobs(alike)} took {_digits(median([each.fixed for each in alike]))} s to start, plan and store, "
        f"and {_digits(median([each.by_photo / each.photos for each in alike]))} s per photo to load and measure.",
    )


def steps_of(options: TrainOptions, photos: int) -> int | None:
    """Return the number of steps for so many training photos, or None where time limits them."""
    if options.steps is not None:
        return options.steps
    if options.timed:
        return None
    return preset_steps(options.ending, photos)


def _size_distance(figures: Figures, options: TrainOptions) -> float:
    if options.image_size is not None:
        return _ratio(figures.image_size, options.image_size)
    return OTHER_PRESET if figures.sized or figures.preset != options.preset.value else 0.0


def _size_factor(figures: Figures, options: TrainOptions) -> float:
    """How much longer a step takes at another size of the photos: the share that is spent on pixels grows with them."""
    if options.image_size is None:
        return 1.0
    return 1.0 + figures.pixel_share * ((options.image_size / figures.image_size) ** 2 - 1.0)


def _nearest(figures: Sequence[Figures], distance: Callable[[Figures], float]) -> list[Figures]:
    """Return the ALIKE figures with the least distance; of equal ones, the newest."""
    return sorted(figures, key=distance)[:ALIKE]


def _ratio(one: float, other: float) -> float:
    return abs(math.log(one / other))


def _stage(name: str, seconds: Sequence[float], because: str) -> StageEstimate:
    return StageEstimate.model_validate(
        {
            "stage": name,
            "seconds": round(median(seconds), 1),
            "lowest": round(min(seconds), 1),
            "highest": round(max(seconds), 1),
            "because": because,
        }
    )


def _sum(numbers: Sequence[float | None], within: float | None) -> float | None:
    known = [number for number in numbers if number is not None]
    if len(known) < len(numbers):
        return within
    return round(min(sum(known), math.inf if within is None else within), 1)


def _jobs(alike: Sequence[Figures]) -> str:
    return "One finished job" if len(alike) == 1 else f"The {len(alike)} finished jobs that are most alike"


def _digits(number: float) -> str:
    """Return a number with two significant digits."""
    return f"{number:.2g}" if number < 100 else f"{number:.0f}"

"""From usable photos to a scene: the effort that their number asks for, and higher ones when too few are registered."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from splatmill.schema import MIN_PHOTOS, KnownDistance
from splatmill.schema.quantities import counted
from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.opencv import VERSION as OPENCV_VERSION
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import cameras, lenses, stereo
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.effort import require_features, solve_at
from splatmill_worker.sfm.final_model import final_model
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.model_store import is_stored, load_model, store_model
from splatmill_worker.sfm.options import (
    EFFORTS,
    HIGH,
    LEAN,
    NEXT_EFFORT,
    STANDARD,
    Effort,
    SfmOptions,
)
from splatmill_worker.sfm.placed import PlacingObserver
from splatmill_worker.sfm.run import VERSION, EffortResult, SfmRun, digest, folder_of, opened
from splatmill_worker.sfm.trials import registered_counts
from splatmill_worker.sfm.unfold import unfold
from splatmill_worker.sfm.world.frame import require_photos

ENOUGH_PLACED = 0.95
"""Share of the photos, reliably registered, from which no higher effort is tried (decisions: ENOUGH_PLACED)."""

FEW_PHOTOS = 30
"""Photos up to which the lean effort is not tried (decisions: FEW_PHOTOS)."""

log = logging.getLogger("splatmill_worker")


def reconstruct(
    images: Path,
    masks: Path | None,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
    observer: PlacingObserver | None = None,
    known: KnownDistance | None = None,
    prepared: Prepared | None = None,
) -> Scene:
    """Recover the cameras of the photos under `images`, and of those in its videos and zips.

    The model is kept in `workdir`: the same photos with the same options are read back from there, and a run that was
    interrupted continues from what it had stored.

    on_progress: called with the stages images, features, pairs, matching, mapping and, where points are few, stereo.
    cancelled: polled; Cancelled is raised within a fraction of a second of it turning true, except that the global
        mapper, a bundle adjustment and the search of a photo for features, ten seconds for a panorama, finish first.
    observer: called with the cameras and points while the incremental mapper places them.
    known: a distance between two photos, which makes the metre the unit of the scene.
    prepared: the photos as `images.prepare` has examined them before; None: they are examined first.

    Raises SfmFailed with facts and advice when no usable model is found, Refusal for a distance between photos that
    are not there, that have no camera, or that are at one place, and Cancelled.
    """
    if prepared is None:
        prepared = prepare(
            images, masks, workdir, frames=options.frames, on_progress=on_progress, cancelled=cancelled
        )
    try:
        return reconstruct_photos(prepared, workdir, options, on_progress, cancelled, observer, known)
    except SfmFailed as error:
        if not prepared.warnings:
            raise
        # What is probably wrong with the files may be the cause, and there will be no report that names it.
        advice = " ".join(filter(None, (error.advice, *prepared.warnings)))
        raise SfmFailed(error.code, error.message, error.facts, advice) from error


def reconstruct_photos(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
    observer: PlacingObserver | None = None,
    known: KnownDistance | None = None,
) -> Scene:
    """`reconstruct` for photos that `images.prepare` has examined."""
    _require_photos(prepared)
    require_photos(known, [photo.name for photo in prepared.photos])
    stop_if(cancelled)
    whole = _model_folder(prepared, workdir, options)
    hurried = whole.with_name(f"{whole.name}-hurried")
    for stored in [whole] if options.seconds is None else [whole, hurried]:
        if not is_stored(stored):
            continue
        try:
            return load_model(prepared, stored, known)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            log.warning(
                "The stored cameras are not readable and are recovered anew: %s: %s", stored.name, error
            )
            shutil.rmtree(stored)
    with opened(prepared, workdir, options, on_progress, cancelled) as run:
        run.observer = observer
        solved = _solve(run)
        run.notes += cameras.fisheye_note(run.groups)
        final = final_model(run, solved)
        stored = hurried if run.hurried else whole
        store_model(run, final, stored)
    return load_model(prepared, stored, known)


def _model_folder(prepared: Prepared, workdir: Path, options: SfmOptions) -> Path:
    versions = VERSION, stereo.VERSION, pycolmap.__version__, OPENCV_VERSION
    return folder_of(prepared, workdir) / f"model-{digest(*versions, options)}"


def has_model(prepared: Prepared, workdir: Path, options: SfmOptions) -> bool:
    """Whether the cameras of these photos are kept in `workdir`, so that `reconstruct_photos` reads them."""
    return is_stored(_model_folder(prepared, workdir, options))


def _require_photos(prepared: Prepared) -> None:
    """Raise SfmFailed when there are too few photos for structure from motion."""
    count = len(prepared.photos)
    facts = {"photos": count, "skipped": [f"{name}: {reason}" for name, reason in prepared.skipped]}
    if count == 0:
        raise SfmFailed(
            "no_images",
            _no_photo(prepared.skipped),
            facts,
            "Give JPEG, PNG, WebP, TIFF, HEIC or AVIF photos, a video, or a zip of photos.",
        )
    if count < MIN_PHOTOS:
        raise SfmFailed(
            "too_few_images",
            f"{counted(count, 'photo is', 'photos are')} usable; at least {MIN_PHOTOS} are needed.",
            facts,
            "Take photos from different places, 20 or more for a good result.",
        )


def _no_photo(skipped: Sequence[tuple[str, str]]) -> str:
    if not skipped:
        return "There is no usable photo."
    name, reason = skipped[0]
    if len(skipped) == 1:
        return f"There is no usable photo. {name}: {reason.rstrip('.')}."
    return f"None of the {len(skipped)} files is a usable photo, such as {name}: {reason.rstrip('.')}."


def efforts(options: SfmOptions, count: int) -> list[Effort]:
    """The efforts to try, in order; a single one where the options name it or set its photo size or features."""
    automatic = [STANDARD, HIGH] if count <= FEW_PHOTOS else [LEAN, STANDARD, HIGH]
    chosen = automatic if options.effort == "auto" else [EFFORTS[options.effort]]
    if options.side is not None or options.features is not None:
        chosen = chosen[:1]
    return [
        replace(effort, side=options.side or effort.side, features=options.features or effort.features)
        for effort in chosen
    ]


def _solve(run: SfmRun) -> EffortResult:
    """The best result of the efforts that were needed."""
    best: EffortResult | None = None
    last: EffortResult | None = None
    best_counts = 0, 0
    for effort in efforts(run.options, run.count):
        if best is not None and last is not None:
            if _finds_the_same(run, last, effort):
                require_features(run, last)
                continue
            if 2 * best_counts[0] >= run.count and not run.has_time_for(NEXT_EFFORT):
                run.hurried = True
                run.notes.append(
                    f"{best_counts[0]} of {run.count} photos were placed reliably with {best.effort.name} effort. "
                    f"There was no time to try {effort.name} effort."
                )
                break
            run.notes.append(
                f"{best_counts[0]} of {run.count} photos were placed reliably with {best.effort.name} effort; "
                f"{effort.name} effort was tried next."
            )
        last = result = solve_at(run, effort, best)
        counts = registered_counts(result.mapped)
        if best is None or counts > best_counts:
            best, best_counts = result, counts
        if best_counts[0] >= ENOUGH_PLACED * run.count:
            break
        if effort.name != LEAN.name and not result.verified:
            break  # a higher effort than the standard one would not match either
    assert best is not None  # efforts returns at least one
    if best_counts[0] < ENOUGH_PLACED * run.count and run.has_time_for(1.0):
        best = _without_fisheyes(run, best)
    unfold(run, best)
    return _with_divided_cameras(run, best)


def _finds_the_same(run: SfmRun, tried: EffortResult, effort: Effort) -> bool:
    """Whether `effort` certainly finds the features of the effort that was tried, and matches the same pairs."""
    matcher = run.options.matcher
    all_pairs = matcher == "exhaustive" or (matcher == "auto" and run.count <= pairs.EXHAUSTIVE_UP_TO)
    return (
        run.reduced_side(effort) == run.reduced_side(tried.effort)
        and all(len(each.scales) < tried.effort.features for each in tried.features)
        and (effort.partners == tried.effort.partners or all_pairs)
    )


def _without_fisheyes(run: SfmRun, result: EffortResult) -> EffortResult:
    """`result`, or the photos of fisheye lenses mapped again as those of ordinary ones, where that places more: a round
    picture may be that of a microscope, and photos without distortion may still name their lens."""
    fisheyes = run.groups
    if not any(group.is_fisheye for group in fisheyes):
        return result
    run.groups = cameras.as_pinholes(fisheyes)
    again = solve_at(run, result.effort, None)
    if registered_counts(again.mapped) <= registered_counts(result.mapped):
        run.groups = fisheyes
        return result
    run.notes.append(
        f"As photos of a fisheye lens, {registered_counts(result.mapped)[0]} of {run.count} were placed reliably, and "
        f"{registered_counts(again.mapped)[0]} as those of an ordinary lens, for which they are taken."
    )
    return again


def _with_divided_cameras(run: SfmRun, result: EffortResult) -> EffortResult:
    """`result`, or the photos mapped again with two cameras for each one whose photos have two focal lengths."""
    model = result.mapped.largest if result.mapped is not None else None
    if model is None or run.options.camera_model != "auto":
        return result
    whole = run.groups
    run.groups = lenses.divided(whole, model, run.threads, run.cancelled)
    if len(run.groups) == len(whole):
        return result
    again = solve_at(run, result.effort, None)
    unfold(run, again)
    if registered_counts(again.mapped) < registered_counts(result.mapped):
        run.groups = whole
        return result
    run.notes.append(
        f"{len(run.groups) - len(whole)} of the cameras had photos of two focal lengths, though of one size and "
        "without EXIF. They are taken to be of two cameras."
    )
    return again

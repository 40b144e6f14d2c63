"""From usable photos to a Scene: lean first, more effort only where what was measured asks for it."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import cameras, checks, stereo
from splatmill_worker.sfm.cancellation import stop_if
from splatmill_worker.sfm.effort import ENOUGH, attempt, edges
from splatmill_worker.sfm.options import EFFORTS, HIGH, LEAN, STANDARD, Effort, SfmOptions, fitted
from splatmill_worker.sfm.run import VERSION, OnProgress, Progress, Run, digest, torch_threads
from splatmill_worker.sfm.stored_model import read, store


def reconstruct(
    images: Path,
    masks: Path | None,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Scene:
    """Recovers the cameras of the photos under `images` (and in videos and zips there).

    `on_progress(stage, done, total, note)` is told of images, features, pairs, matching, mapping and, where
    points are few, stereo. The same photos with the same options are read back from `workdir`; a restart goes on
    where the last one stopped.

    Raises SfmFailed with facts and advice, and Cancelled within a fraction of a second of `cancelled()` turning
    true (the global mapper and a single bundle adjustment finish first).
    """
    prepared = prepare(
        images, masks, workdir, frames=options.frames, on_progress=on_progress, cancelled=cancelled
    )
    return reconstruct_photos(prepared, workdir, options, on_progress, cancelled)


def reconstruct_photos(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Scene:
    """`reconstruct` for photos that were looked through already."""
    _require_photos(prepared)
    stop_if(cancelled)
    folder = workdir / "sfm" / prepared.key[:24]
    stored = folder / f"model-{digest(VERSION, stereo.VERSION, pycolmap.__version__, options)}"
    if not (stored / "facts.json").is_file():
        threads = options.threads or os.cpu_count() or 1
        groups = cameras.group(prepared.photos)
        model = options.camera_model if options.camera_model != "auto" else "SIMPLE_RADIAL"
        # One thread for each torch call: the pairs themselves run side by side.
        with ThreadPoolExecutor(threads) as pool, torch_threads(1):
            run = Run(prepared, groups, model, options, folder, threads, pool, on_progress, cancelled)
            store(run, _solve(run), stored)
    return read(prepared, stored)


def _require_photos(prepared: Prepared) -> None:
    count = len(prepared.photos)
    facts = {"photos": count, "skipped": [f"{name}: {reason}" for name, reason in prepared.skipped]}
    if count == 0:
        raise SfmFailed(
            "no_images",
            f"None of the {len(prepared.skipped)} files is a usable photo.",
            facts,
            "Give JPEG, PNG, WebP, TIFF or HEIC photos, a video, or a zip of photos.",
        )
    if count < checks.MIN_REGISTERED:
        raise SfmFailed(
            "too_few_images",
            f"There {'is' if count == 1 else 'are'} {count} usable photo{'s' if count > 1 else ''}.",
            facts,
            "Take at least 3 from different places, better 20 or more.",
        )


def _efforts(options: SfmOptions, longest_side: int) -> list[Effort]:
    """What to try, in order; a forced effort, size or number of features is not raised."""
    chosen = [LEAN, STANDARD, HIGH] if options.effort == "auto" else [EFFORTS[options.effort]]
    if options.side is not None or options.features is not None:
        chosen = chosen[:1]
    forced = [
        replace(effort, side=options.side or effort.side, features=options.features or effort.features)
        for effort in chosen
    ]
    return [fitted(effort, longest_side) for effort in forced]


def _solve(run: Run) -> Progress:
    """The best result over the efforts that were needed; raises SfmFailed where none is usable."""
    best: Progress | None = None
    longest = int(np.median([max(photo.width, photo.height) for photo in run.prepared.photos]))
    for effort in _efforts(run.options, longest):
        if best is not None:
            run.notes.append(
                f"With {best.effort.name} effort {_placed(best)[0]} of {run.count} photos surely found their place."
            )
        progress = attempt(run, effort, best)
        if best is None or _placed(progress) > _placed(best):
            best = progress
        if _placed(best)[0] >= ENOUGH * run.count:
            break
        if effort.name != LEAN.name and not edges(progress):
            break  # not one pair matched on three times the features: more of them only take longer
    assert best is not None  # _efforts gives at least one
    return best


def _placed(progress: Progress) -> tuple[int, int]:
    """Photos surely placed, and placed at all."""
    if progress.mapped is None:
        return 0, 0
    return checks.trusted(progress.mapped.largest), progress.mapped.registered

"""From usable photos to a Scene: lean first, more effort only where what was measured asks for it."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm import cameras, checks, colors, features, geometry, mapping, pairs, stereo
from splatmill_worker.sfm.cameras import Group
from splatmill_worker.sfm.cancellation import stop_if
from splatmill_worker.sfm.colmap_model import posed_view, scene_of
from splatmill_worker.sfm.failure import Cancelled, SfmFailed
from splatmill_worker.sfm.features import Features, Workspace
from splatmill_worker.sfm.options import EFFORTS, HIGH, LEAN, STANDARD, Effort, SfmOptions, fitted

STEREO = "stereo.npz"
OnProgress = Callable[[str, int, int, str], None]
VERSION = 4  # of what is cached; another one means the cache of an older program is not read
REPAIR_ROUNDS = 2
ENOUGH = 0.9  # of the photos surely placed: below, more effort is spent
PARTNERS_AGAIN = 4  # of a photo without a sure place, that are looked at harder together with it
NEARLY_ALL = 0.8  # of the photos: then all are
GLOBAL_FROM = 400  # photos: from here on the global mapper goes first where the view graph is dense


@dataclass
class Progress:
    """What one effort has found so far."""

    effort: Effort
    place: Workspace
    ids: dict[int, int] = field(default_factory=dict)
    features: list[Features] = field(default_factory=list)
    verified: dict[pairs.Pair, geometry.Verified] = field(default_factory=dict)
    mapped: mapping.Mapped | None = None


@dataclass
class Run:
    """One call of `reconstruct`: its inputs, its threads, its clocks, and what carries over between efforts."""

    prepared: Prepared
    groups: list[Group]
    model: str
    options: SfmOptions
    folder: Path
    threads: int
    pool: ThreadPoolExecutor
    on_progress: OnProgress
    cancelled: Callable[[], bool]
    scores: dict[pairs.Pair, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    best_mapper: mapping.Mapper | None = None  # that did best on what was matched so far

    @property
    def count(self) -> int:
        return len(self.prepared.photos)

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - started


def reconstruct(
    images: Path,
    masks: Path | None,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Scene:
    """Recovers the cameras of the photos under `images` (and in videos and zips there).

    `on_progress(stage, done, total, note)` is told of images, features, pairs, matching and mapping. The same
    photos with the same options are read back from `workdir`; a restart goes on where the last one stopped.

    Raises SfmFailed with facts and advice, and Cancelled within a fraction of a second of `cancelled()` turning
    true (the global mapper and a single bundle adjustment finish first).
    """
    try:
        prepared = prepare(
            images, masks, workdir, frames=options.frames, on_progress=on_progress, cancelled=cancelled
        )
    except InterruptedError as error:
        raise Cancelled(str(error)) from error
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
    stored = folder / f"model-{_digest(VERSION, pycolmap.__version__, options)}"
    if not (stored / "facts.json").is_file():
        threads = options.threads or os.cpu_count() or 1
        groups = cameras.group(prepared.photos)
        model = options.camera_model if options.camera_model != "auto" else "SIMPLE_RADIAL"
        with ThreadPoolExecutor(threads) as pool, _one_thread_each():
            run = Run(prepared, groups, model, options, folder, threads, pool, on_progress, cancelled)
            _store(run, _solve(run), stored)
    return _read(prepared, stored)


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


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """One thread for each torch call: the pairs themselves run side by side."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
        progress = _attempt(run, effort, best)
        if best is None or _placed(progress) > _placed(best):
            best = progress
        if _placed(best)[0] >= ENOUGH * run.count:
            break
        if effort.name != LEAN.name and not _edges(progress):
            break  # not one pair matched on three times the features: more of them only take longer
    assert best is not None  # _efforts gives at least one
    return best


def _placed(progress: Progress) -> tuple[int, int]:
    """Photos surely placed, and placed at all."""
    if progress.mapped is None:
        return 0, 0
    return checks.trusted(progress.mapped.largest), progress.mapped.registered


def _attempt(run: Run, effort: Effort, earlier: Progress | None) -> Progress:
    """Features, pairs, matches and mapping at one effort; photos left over get matched with more partners.

    What is sure from `earlier` is kept where the photos are looked at in the same size.
    """
    doubtful = _in_doubt(run, earlier) if earlier is not None and earlier.effort.side == effort.side else None
    key = _digest(VERSION, effort, run.model, [group.focal for group in run.groups], sorted(doubtful or ()))
    progress = Progress(effort, Workspace(run.folder / f"{effort.name}-{key}"))
    with run.clock("features"):
        if earlier is not None and doubtful is not None:
            features.carry_over(earlier.place, progress.place, doubtful)
        features.extract(
            run.prepared.photos,
            run.groups,
            effort,
            run.model,
            progress.place,
            run.threads,
            run.on_progress,
            run.cancelled,
        )
    database = pycolmap.Database.open(progress.place.database)
    try:
        with run.clock("features"):
            progress.ids, progress.features = features.load(database)
        if len(progress.ids) < run.count:
            raise OSError(
                f"COLMAP could read only {len(progress.ids)} of the {run.count} reduced photos in "
                f"{progress.place.images}. Is the disk full?"
            )
        _require_features(run, progress)
        chosen = _choose(run, progress)
        _match(run, progress, chosen, database)
        for _ in range(REPAIR_ROUNDS):
            parts = pairs.components(run.count, _edges(progress))
            more = (
                pairs.bridges(parts, run.scores, set(progress.verified), effort.partners)
                if len(parts) > 1
                else set()
            )
            if not more:
                break
            _match(run, progress, more, database)
        if not _edges(progress):
            return progress
        progress.mapped = _map(run, progress)
        left = _unregistered(run, progress)
        if left and _match_left_over(run, progress, left, database):
            again, before = _map(run, progress), progress.mapped
            if (checks.trusted(again.largest), again.registered) > (
                checks.trusted(before.largest),
                before.registered,
            ):
                progress.mapped = again
    finally:
        database.close()
    return progress


def _in_doubt(run: Run, progress: Progress) -> set[int] | None:
    """Photos without a sure place, and the likeliest partners of each; None where that is nearly all of them."""
    model = progress.mapped.largest if progress.mapped is not None else None
    sure = (
        set()
        if model is None
        else {features.photo_index(model.images[i].name) for i in checks.trusted_images(model)}
    )
    doubtful = set(range(run.count)) - sure
    partners = {
        index
        for photo in doubtful
        for pair in pairs.likeliest(run.scores, photo, PARTNERS_AGAIN)
        for index in pair
    }
    both = doubtful | partners
    return None if not run.scores or len(both) > NEARLY_ALL * run.count else both


def _require_features(run: Run, progress: Progress) -> None:
    counts = [len(found.scales) for found in progress.features]
    if progress.effort.name != LEAN.name and float(np.median(counts)) < 2 * geometry.MIN_INLIERS:
        raise SfmFailed(
            "sfm_no_features",
            f"Half of the {run.count} photos have fewer than {int(np.median(counts)) + 1} features.",
            {"photos": run.count, "features_per_photo": float(np.median(counts))},
            "Plain walls, blur and darkness leave nothing to match: take sharp photos of something with texture.",
        )


def _choose(run: Run, progress: Progress) -> set[pairs.Pair]:
    """The pairs to match in full, by the options or by what the photos are."""
    photos, partners = run.prepared.photos, progress.effort.partners
    matcher = run.options.matcher
    places = pairs.positions(photos)
    has_gps = bool(np.isfinite(places).all(axis=1).mean() > 0.5)
    if matcher == "spatial" and not has_gps:
        run.notes.append("Neighbours by GPS were asked for, but most photos have no place in their EXIF.")
    if matcher == "exhaustive" or (matcher == "auto" and run.count <= pairs.EXHAUSTIVE_UP_TO):
        return set(pairs.exhaustive(run.count))
    runs = pairs.sequences(photos)
    if matcher == "sequential":
        runs = [list(range(run.count))]
    likely = {pair for order in runs for pair in pairs.sequential(order)}
    if matcher == "auto":
        likely |= {
            pair for order in pairs.bursts(photos) for pair in pairs.sequential(order, pairs.BURST_STEPS)
        }
    if has_gps and matcher in ("auto", "spatial"):
        likely |= pairs.spatial(places, partners if matcher == "spatial" else partners // 2)
    with run.clock("pairs"):
        if not run.scores:
            run.scores = pairs.quick_look(
                progress.features,
                likely,
                run.pool,
                lambda done, total: run.on_progress(
                    "pairs", done, total, "a quick look at which photos overlap"
                ),
                run.cancelled,
            )
    forced = matcher in ("sequential", "spatial") and bool(likely)
    # A forced order still gets the best few by looks, which close loops.
    return likely | pairs.best_partners(run.scores, run.count, pairs.SURE_PARTNERS if forced else partners)


def _match(run: Run, progress: Progress, chosen: set[pairs.Pair], database: pycolmap.Database) -> None:
    total = len(progress.verified) + len(chosen)
    before = len(progress.verified)
    with run.clock("matching"):
        progress.verified |= geometry.match_pairs(
            chosen,
            progress.features,
            progress.ids,
            database,
            progress.effort.features,
            run.options.seed,
            run.pool,
            lambda done, _: run.on_progress("matching", before + done, total, "pairs"),
            run.cancelled,
        )


def _edges(progress: Progress) -> list[pairs.Pair]:
    return [pair for pair, found in progress.verified.items() if found.inliers >= geometry.MIN_INLIERS]


def _map(run: Run, progress: Progress) -> mapping.Mapped:
    """Maps by the mapper the photos speak for, then by the other or with relaxed settings where that falls short."""
    asked = run.options.mapper
    first: mapping.Mapper = "incremental"
    if asked != "auto":
        first = asked
    elif run.best_mapper is not None:
        first = run.best_mapper
    elif run.count >= GLOBAL_FROM and len(_edges(progress)) >= 5 * run.count:
        first = "global"
    trials: list[tuple[mapping.Mapper, bool]] = [(first, False)]
    if asked == "auto":
        trials.append(("global" if first == "incremental" else "incremental", False))
    if asked != "global":
        trials.append(("incremental", True))
    best: mapping.Mapped | None = None
    most = 0
    with run.clock("mapping"):
        for mapper, relaxed in trials:
            result = mapping.run(
                mapper,
                progress.place.database,
                run.count,
                run.threads,
                run.options.seed,
                relaxed=relaxed,
                on_progress=lambda done, total: run.on_progress("mapping", done, total, "photos placed"),
                cancelled=run.cancelled,
            )
            sure = checks.trusted(result.largest)
            if best is None or (sure, result.registered) > (most, best.registered):
                best, most = result, sure
            if most >= ENOUGH * run.count:
                break
    assert best is not None  # there is at least one trial
    run.best_mapper = best.mapper
    return best


def _unregistered(run: Run, progress: Progress) -> list[int]:
    largest = progress.mapped.largest if progress.mapped is not None else None
    placed = _photos_of(largest) if largest is not None else set()
    return [index for index in range(run.count) if index not in placed]


def _match_left_over(run: Run, progress: Progress, left: list[int], database: pycolmap.Database) -> bool:
    """Matches photos without a place with more of those that have one; whether that held any new pair."""
    parts = [[index for index in range(run.count) if index not in left], left]
    more = pairs.bridges(parts, run.scores, set(progress.verified), 2 * progress.effort.partners)
    if not more:
        return False
    before = len(_edges(progress))
    _match(run, progress, more, database)
    return len(_edges(progress)) > before


def _store(run: Run, progress: Progress, target: Path) -> None:
    """Checks the largest model, finishes it, and writes it with its facts; raises SfmFailed where it is not usable."""
    model = progress.mapped.largest if progress.mapped is not None else None
    facts = checks.pair_facts(progress.verified) | {"effort": progress.effort.name}
    if model is None:
        checks.require_usable(checks.model_facts(None, run.count) | facts)
        raise AssertionError("a run without a model is never usable")
    model, fixed = _with_possible_intrinsics(run, progress, model)
    misplaced = checks.drop_misplaced(model)
    with run.clock("polish"):
        model = _polished(run, model, fixed)
    facts |= checks.model_facts(model, run.count)
    checks.require_usable(facts)
    reasons = {
        features.photo_index(model.images[image_id].name): reason for image_id, reason in misplaced.items()
    }
    reasons = _reasons(run, progress, model) | reasons
    with run.clock("colors"):
        views = _views(run.prepared, model)
        colors.paint(model, views, run.pool)
    facts["features_per_photo"] = float(np.median([len(found.scales) for found in progress.features]))
    facts |= _model_facts(run, progress, model)
    facts["seconds"] = {stage: round(seconds, 3) for stage, seconds in run.seconds.items()}
    partial = target.with_name(f"{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.write_binary(partial)
    left_out = {run.prepared.photos[index].name: reason for index, reason in reasons.items()}
    document = {"facts": facts, "left_out": left_out, "notes": run.notes}
    (partial / "facts.json").write_text(json.dumps(document, indent=1), "utf-8")
    if run.options.stereo:
        run.on_progress("stereo", 0, len(views), "points between those found")
        stereo.completed(_read(run.prepared, partial), partial / STEREO, run.cancelled)
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)


def _model_facts(run: Run, progress: Progress, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Which mapper made the model, how many others were joined to it, and the photos of those that were not."""
    mapped = progress.mapped
    if mapped is None:
        return {"mapper": None}
    placed = _photos_of(model)
    others = [sorted(_photos_of(other) - placed) for other in mapped.models[1:]]
    return {
        "mapper": mapped.mapper,
        "merged_models": mapped.joined,
        "other_models": [[run.prepared.photos[index].name for index in own] for own in others if own],
    }


def _photos_of(model: pycolmap.Reconstruction) -> set[int]:
    return {features.photo_index(model.images[i].name) for i in model.reg_image_ids()}


def _polished(run: Run, model: pycolmap.Reconstruction, fixed: bool) -> pycolmap.Reconstruction:
    """The model after its last bundle adjustment, with finer lenses where that leads to lenses that exist."""
    if not fixed and run.options.camera_model == "auto":
        finer = copy.deepcopy(model)
        if mapping.refine_lenses(finer):
            mapping.polish(finer, run.threads, fixed_intrinsics=False, cancelled=run.cancelled)
            if checks.absurd_intrinsics(finer) is None:
                return finer
    mapping.polish(model, run.threads, fixed_intrinsics=fixed, cancelled=run.cancelled)
    return model


def _with_possible_intrinsics(
    run: Run, progress: Progress, model: pycolmap.Reconstruction
) -> tuple[pycolmap.Reconstruction, bool]:
    """The model, mapped again with its cameras held where they started if they became what no lens can be."""
    absurd = checks.absurd_intrinsics(model)
    if absurd is None:
        return model, False
    run.notes.append(
        f"The photos led to {absurd}, which no lens has; the cameras were held at their first guess."
    )
    with run.clock("mapping"):
        again = mapping.run(
            "incremental",
            progress.place.database,
            run.count,
            run.threads,
            run.options.seed,
            fixed_intrinsics=True,
            on_progress=lambda done, total: run.on_progress("mapping", done, total, "photos placed"),
            cancelled=run.cancelled,
        )
    if again.largest is None or again.registered < checks.floor(run.count):
        facts = checks.pair_facts(progress.verified) | checks.model_facts(again.largest, run.count)
        raise SfmFailed(
            "sfm_failed",
            f"The photos led to {absurd}, which no lens has, and with the usual lens only {again.registered} of "
            f"{run.count} images could be placed.",
            facts,
            "Give the original photos, neither cropped nor taken at different zooms, from more sides.",
        )
    progress.mapped = again
    return again.largest, True


def _reasons(run: Run, progress: Progress, model: pycolmap.Reconstruction) -> dict[int, str]:
    """Why each photo without a camera has none; photos that form a smaller model of their own are told apart."""
    placed = _photos_of(model)
    partners: dict[int, int] = {}
    for pair in _edges(progress):
        for index in pair:
            partners[index] = partners.get(index, 0) + 1
    reasons = {}
    for index in range(run.count):
        if index in placed:
            continue
        if not partners.get(index):
            reasons[index] = "no other photo shows enough of what it shows"
        else:
            reasons[index] = f"it matches {partners[index]} other photos, but not well enough to be placed"
    for number, other in enumerate(progress.mapped.models[1:] if progress.mapped is not None else (), 2):
        own = _photos_of(other) - placed
        for index in own & reasons.keys():
            reasons[index] = (
                f"it belongs to a part of {len(own)} photos that shares too little with the others (model {number})"
            )
    return reasons


def _views(prepared: Prepared, model: pycolmap.Reconstruction) -> dict[int, View]:
    """The view of each registered image by image id, in the order of the photos' names."""
    by_photo = {features.photo_index(model.images[i].name): i for i in model.reg_image_ids()}
    views = {}
    for index in sorted(by_photo):
        photo = prepared.photos[index]
        view = posed_view(model, by_photo[index], photo.name, photo.path, photo.mask)
        camera = view.camera.scaled_to(photo.width, photo.height)
        views[by_photo[index]] = replace(view, camera=camera, upright=True)
    return views


def _read(prepared: Prepared, stored: Path) -> Scene:
    """The scene of a stored model; its photos are where they are now."""
    model = pycolmap.Reconstruction(stored)
    document: dict[str, Any] = json.loads((stored / "facts.json").read_text("utf-8"))
    scene = scene_of(
        model,
        _views(prepared, model),
        source="sfm",
        left_out=(*prepared.skipped, *document["left_out"].items()),
        notes=(*prepared.notes, *document["notes"]),
    )
    scene = replace(scene, facts=document["facts"])
    return stereo.add(scene, stereo.Added.load(stored / STEREO)) if (stored / STEREO).is_file() else scene


def _digest(*values: object) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]

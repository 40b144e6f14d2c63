"""Features, pairs, matches and mapping at one effort."""

from __future__ import annotations

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm import checks, features, geometry, mapping, pairs
from splatmill_worker.sfm.features import Workspace
from splatmill_worker.sfm.options import LEAN, Effort
from splatmill_worker.sfm.run import VERSION, Progress, Run, digest

REPAIR_ROUNDS = 2
ENOUGH = 0.9  # of the photos surely placed: below, more effort is spent
PARTNERS_AGAIN = 4  # of a photo without a sure place, that are looked at harder together with it
NEARLY_ALL = 0.8  # of the photos: then all are
GLOBAL_FROM = 400  # photos: from here on the global mapper goes first where the view graph is dense


def attempt(run: Run, effort: Effort, earlier: Progress | None) -> Progress:
    """Features, pairs, matches and mapping at one effort; photos left over get matched with more partners.

    What is sure from `earlier` is kept where the photos are looked at in the same size.
    """
    doubtful = _in_doubt(run, earlier) if earlier is not None and earlier.effort.side == effort.side else None
    key = digest(
        VERSION,
        effort,
        run.options.matcher,
        run.options.seed,
        run.model,
        [group.focal for group in run.groups],
        sorted(doubtful or ()),
    )
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
            parts = pairs.components(run.count, edges(progress))
            more = (
                pairs.bridges(parts, run.scores, set(progress.verified), effort.partners)
                if len(parts) > 1
                else set()
            )
            if not more:
                break
            _match(run, progress, more, database)
        if not edges(progress):
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
    if not run.scores or len(doubtful) > NEARLY_ALL * run.count:
        return None
    chosen = pairs.likeliest(run.scores, run.count, doubtful, PARTNERS_AGAIN)
    both = doubtful.union(*chosen)
    return None if len(both) > NEARLY_ALL * run.count else both


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


def edges(progress: Progress) -> list[pairs.Pair]:
    """Pairs of photos that hold."""
    return [pair for pair, found in progress.verified.items() if found.inliers >= geometry.MIN_INLIERS]


def _map(run: Run, progress: Progress) -> mapping.Mapped:
    """Maps by the mapper the photos speak for, then by the other or with relaxed settings where that falls short."""
    asked = run.options.mapper
    first: mapping.Mapper = "incremental"
    if asked != "auto":
        first = asked
    elif run.best_mapper is not None:
        first = run.best_mapper
    elif run.count >= GLOBAL_FROM and len(edges(progress)) >= 5 * run.count:
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
    placed = photos_of(largest) if largest is not None else set()
    return [index for index in range(run.count) if index not in placed]


def _match_left_over(run: Run, progress: Progress, left: list[int], database: pycolmap.Database) -> bool:
    """Matches photos without a place with more of those that have one; whether that held any new pair."""
    parts = [[index for index in range(run.count) if index not in left], left]
    more = pairs.bridges(parts, run.scores, set(progress.verified), 2 * progress.effort.partners)
    if not more:
        return False
    before = len(edges(progress))
    _match(run, progress, more, database)
    return len(edges(progress)) > before


def photos_of(model: pycolmap.Reconstruction) -> set[int]:
    """The photos that have a place in a model."""
    return {features.photo_index(model.images[i].name) for i in model.reg_image_ids()}

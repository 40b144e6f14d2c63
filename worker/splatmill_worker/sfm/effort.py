"""Structure from motion at one effort: features, pairs, matches and mapping."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.opencv import VERSION as OPENCV_VERSION
from splatmill_worker.sfm import features
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.mapping.cluster_models import mapped_cluster
from splatmill_worker.sfm.mapping.clusters import divide, number_of_clusters
from splatmill_worker.sfm.mapping.registered import registered
from splatmill_worker.sfm.matching import pairs, two_view
from splatmill_worker.sfm.options import LEAN, Effort
from splatmill_worker.sfm.run import VERSION, EffortResult, SfmRun, digest
from splatmill_worker.sfm.trials import best_mapping, extended_mapping, registered_counts

CONNECTING_ROUNDS = 2
"""Largest number of times that more pairs are matched to connect the components of the view graph."""

SCORES = "scores.npz"
"""File beside a database with the scores of candidate pairs that another process has found by its features."""

RETRY_PARTNERS = 4
"""Likely partners of each photo without a reliable pose whose features are found anew, together with its own."""

RETRY_ALL = 0.8
"""Share of the photos: where the features of more would be found anew, those of all of them are."""


def solve_at(run: SfmRun, effort: Effort, earlier: EffortResult | None) -> EffortResult:
    """Find features, match pairs and map the photos at one effort.

    What `earlier` found of photos that it registered reliably is kept when both efforts use photos of the same size:
    features and pairs, and their poses and points where these photos are half of all. Raises SfmFailed when the
    photos have too few features, and Cancelled.
    """
    retried = None
    if earlier is not None and run.reduced_side(earlier.effort) == run.reduced_side(effort):
        retried = _retried(run, earlier)
    result = EffortResult(effort, database_of(run, effort, retried))
    if earlier is not None and retried is not None:
        with run.clock("features"):
            features.carry_over(earlier.database, result.database, retried)
    find_features(run, result)
    database = pycolmap.Database.open(result.database)
    try:
        if effort.name != LEAN.name:  # a higher effort may find more
            require_features(run, result)
        match(run, result, select_pairs(run, result), database)
        kept = None if earlier is None or retried is None else _without(earlier.mapped, retried)
        if kept is not None and 2 * kept.registered < run.count:
            kept = None
        # By these pairs alone, as other processes map them.
        cluster_models = [] if kept is not None else map_clusters(run, result)
        _connect(run, result, database)
        if not result.verified:
            return result
        if kept is not None:
            result.mapped = extended_mapping(run, result.database, kept)
        else:
            result.mapped = best_mapping(run, result.database, result.verified, cluster_models)
        left = _unregistered(run, result)
        if left and _match_unregistered(run, result, left, database):
            result.mapped = _mapped_with_more(run, result, result.mapped)
    finally:
        database.close()
    return result


def database_of(run: SfmRun, effort: Effort, retried: set[int] | None = None) -> Path:
    """Where an effort keeps features and matches. retried: photos whose features it finds anew, of an earlier one."""
    key = digest(
        VERSION,
        OPENCV_VERSION,
        effort,
        run.options.matcher,
        run.options.seed,
        run.camera_model,
        [(group.photos, group.focal, group.center, group.is_fisheye) for group in run.groups],
        sorted(retried or ()),
    )
    return run.folder / f"{effort.name}-{key}" / "database.db"


def find_features(run: SfmRun, result: EffortResult, only: Collection[int] | None = None) -> None:
    """Find the features of the photos, or of those with the indices `only`, that the database of the effort lacks, and
    let the result have them."""
    groups = run.groups
    if only is not None:  # the number of a camera is its place among all of them
        groups = [
            replace(group, photos=tuple(index for index in group.photos if index in only)) for group in groups
        ]
    with run.clock("features"):
        features.extract(
            run.prepared.photos,
            groups,
            result.effort,
            run.camera_model,
            result.database,
            run.pool,
            run.on_progress,
            run.cancelled,
        )
        with closing(pycolmap.Database.open(result.database)) as database:
            result.ids, result.features = features.load(database, only)


def _without(mapped: mapper.Mapped | None, retried: set[int]) -> mapper.Mapped | None:
    """The largest of the models without the photos `retried`, which get other features."""
    if mapped is None or mapped.largest is None:
        return None
    model = copy.deepcopy(mapped.largest)
    for image_id in model.reg_image_ids():
        if features.photo_index(model.images[image_id].name) in retried:
            model.deregister_frame(model.images[image_id].frame_id)
    return replace(mapped, models=(registered(model),))


def _mapped_with_more(run: SfmRun, result: EffortResult, mapped: mapper.Mapped) -> mapper.Mapped:
    """`mapped` with photos placed by pairs that were verified since: added to its largest model, or mapped anew.

    They are mapped anew only where the model has less than half of the photos, and so may be of the wrong part.
    """
    if 2 * mapped.registered >= run.count:
        again = extended_mapping(run, result.database, mapped)
    else:
        again = best_mapping(run, result.database, result.verified)
    return again if registered_counts(again) > registered_counts(mapped) else mapped


def registered_photos(model: pycolmap.Reconstruction) -> set[int]:
    """Indices of the photos that a model has registered."""
    return {features.photo_index(model.images[i].name) for i in model.reg_image_ids()}


def _retried(run: SfmRun, result: EffortResult) -> set[int] | None:
    """Photos whose features the next effort finds anew: those without a reliable pose, and their likely partners.

    None, for all photos, when these are more than RETRY_ALL of them or when no pairs have been scored.
    """
    model = result.mapped.largest if result.mapped is not None else None
    reliable = (
        set()
        if result.mapped is None or model is None
        else {features.photo_index(model.images[i].name) for i in result.mapped.reliable}
    )
    unreliable = set(range(run.count)) - reliable
    if not run.scores or len(unreliable) > RETRY_ALL * run.count:
        return None
    chosen = pairs.best_pairs_of(unreliable, run.scores, run.count, RETRY_PARTNERS)
    retried = unreliable.union(*chosen)
    return None if len(retried) > RETRY_ALL * run.count else retried


def require_features(run: SfmRun, result: EffortResult) -> None:
    """Raise SfmFailed when half of the photos have too few features."""
    median = float(np.median([len(each.scales) for each in result.features]))
    least = 2 * two_view.MIN_INLIERS
    if median < least:
        raise SfmFailed(
            "sfm_no_features",
            f"Half of the {run.count} photos have at most {int(median)} features; at least {least} are needed.",
            {"photos": run.count, "features_per_photo": median},
            "Plain walls, blur and darkness have no features: take sharp, bright photos of things with texture.",
        )


def select_pairs(run: SfmRun, result: EffortResult) -> set[pairs.Pair]:
    """The pairs to match in full, by the options, the order of the photos, GPS and preemptive matching."""
    photos, partners = run.prepared.photos, result.effort.partners
    matcher = run.options.matcher
    positions = pairs.gps_positions(photos)
    has_gps = bool(np.isfinite(positions).all(axis=1).mean() > 0.5)
    if matcher == "spatial" and not has_gps:
        run.notes.append(
            "matcher=spatial has no effect: most photos have no GPS position in their EXIF. Pairs are chosen by "
            "their features instead."
        )
    if matcher == "exhaustive" or (matcher == "auto" and run.count <= pairs.EXHAUSTIVE_UP_TO):
        return set(pairs.exhaustive(run.count))
    orders = pairs.video_sequences(photos)
    if matcher == "sequential":
        orders = [list(range(run.count))]
    likely = {pair for order in orders for pair in pairs.sequential(order)}
    if matcher == "auto":
        likely |= {
            pair
            for order in pairs.numbered_runs(photos)
            for pair in pairs.sequential(order, pairs.NUMBERED_STEPS)
        }
    if has_gps and matcher in ("auto", "spatial"):
        likely |= pairs.spatial(positions, partners if matcher == "spatial" else partners // 2)
    with run.clock("pairs"):
        if not run.scores:
            run.scores = _stored_scores(result)
        if not run.scores:
            run.scores = pairs.preemptive_matches(
                result.features,
                likely,
                run.pool,
                lambda done, total: run.on_progress("pairs", done, total, "pairs compared for overlap"),
                run.cancelled,
            )
    given_order = matcher in ("sequential", "spatial") and bool(likely)
    # Neighbours in time or space do not include the other end of a loop: the best few pairs of each photo may.
    return likely | pairs.best_partners(
        run.scores, run.count, pairs.CERTAIN_PARTNERS if given_order else partners
    )


def _stored_scores(result: EffortResult) -> dict[pairs.Pair, int]:
    """The scores of the candidate pairs that another process has left; empty without them."""
    path = result.database.with_name(SCORES)
    if not path.is_file():
        return {}
    with np.load(path) as stored:
        rows = stored["scores"].tolist()
    return {(first, second): score for first, second, score in rows}


def match(run: SfmRun, result: EffortResult, chosen: set[pairs.Pair], database: pycolmap.Database) -> None:
    """Match the `chosen` pairs and add their outcomes to the result."""
    total = len(result.matched) + len(chosen)
    before = len(result.matched)
    with run.clock("matching"):
        result.matched |= two_view.match_pairs(
            chosen,
            result.features,
            result.ids,
            database,
            run.options.seed,
            run.pool,
            lambda done, _: run.on_progress("matching", before + done, total, "pairs matched"),
            run.cancelled,
        )


def map_clusters(
    run: SfmRun, result: EffortResult, chosen: Callable[[int], Iterable[int]] = range
) -> list[pycolmap.Reconstruction]:
    """The models of the clusters of the photos, each mapped apart; none where photos are few or another mapper is asked
    for.

    chosen: the numbers of the clusters to map, by how many there are; all of them if it is left out.

    The models are stored beside the database. Raises Cancelled.
    """
    if "global" in (run.options.mapper, run.best_mapper) or not number_of_clusters(run.count):
        return []
    models: list[pycolmap.Reconstruction] = []
    largest = 2

    def show(model: pycolmap.Reconstruction) -> None:
        nonlocal largest
        # Each has a world of its own: a smaller one after a larger one would be another picture.
        if model.num_reg_images() > largest:
            largest = model.num_reg_images()
            run.show(model)

    with run.clock("mapping"):
        run.on_mapping(0, run.count, "dividing the photos into parts")
        inliers = {pair: result.matched[pair].inliers for pair in result.verified}
        clusters = divide(run.count, inliers, run.cancelled)
        numbers = list(chosen(len(clusters)))
        total, before = sum(len(clusters[number]) for number in numbers), 0
        count = run.count if len(numbers) == len(clusters) else total  # some photos are in several clusters
        for number in numbers:
            words = f"part {number + 1} of {len(clusters)}, photos placed"

            def report(placed: int, before: int = before, words: str = words) -> None:
                run.on_mapping(count * (before + placed) // total, count, words)

            models += mapped_cluster(
                result.database,
                [result.ids[index] for index in clusters[number]],
                run.threads,
                run.options.seed,
                on_progress=report,
                on_model=show,
                cancelled=run.cancelled,
            )
            before += len(clusters[number])
    return models


def _connect(run: SfmRun, result: EffortResult, database: pycolmap.Database) -> None:
    """Match more pairs between the components of the view graph, while there are several."""
    for _ in range(CONNECTING_ROUNDS):
        components = pairs.connected_components(run.count, result.verified)
        if len(components) == 1:
            return
        more = pairs.connecting_pairs(components, run.scores, set(result.matched), result.effort.partners)
        if not more:
            return
        match(run, result, more, database)


def _unregistered(run: SfmRun, result: EffortResult) -> list[int]:
    """Indices of the photos that the largest model has not registered."""
    largest = result.mapped.largest if result.mapped is not None else None
    registered = registered_photos(largest) if largest is not None else set()
    return [index for index in range(run.count) if index not in registered]


def _match_unregistered(
    run: SfmRun, result: EffortResult, left: list[int], database: pycolmap.Database
) -> bool:
    """Match the unregistered photos `left` with more of the others; returns whether any new pair was verified."""
    parts = [[index for index in range(run.count) if index not in left], left]
    more = pairs.connecting_pairs(parts, run.scores, set(result.matched), 2 * result.effort.partners)
    if not more:
        return False
    before = len(result.verified)
    match(run, result, more, database)
    return len(result.verified) > before

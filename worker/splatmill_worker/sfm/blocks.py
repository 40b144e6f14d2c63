"""The parts of structure from motion that several processes do at a time: the features of a block of photos, the scores
of pairs of photos, the matches of a block of pairs, and the mapping of a block of clusters.

Each leaves a COLMAP database, or what lies beside it, in the folder in which `reconstruct_photos` would have it.
`merge` brings them together there, and `reconstruct_photos` finds only what is missing. They are those of the first
effort: a higher one, where it is tried, is left to `reconstruct_photos`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import Prepared
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.effort import (
    SCORES,
    database_of,
    find_features,
    map_clusters,
    match,
    select_pairs,
)
from splatmill_worker.sfm.features import FEATURES, completed, merge_databases, pairs_in, photos_in
from splatmill_worker.sfm.mapping.cluster_models import CLUSTERS
from splatmill_worker.sfm.options import SfmOptions
from splatmill_worker.sfm.run import SFM, EffortResult, SfmRun, opened
from splatmill_worker.sfm.solve import efforts

MERGING = "blocks brought together"
"""Note of the progress of `merge`."""


@dataclass(frozen=True)
class Block:
    """The part `number`, from 1, of `blocks` parts of equal size."""

    number: int
    blocks: int

    def of(self, count: int) -> range:
        """The indices of this part of `count` things."""
        return range(count * (self.number - 1) // self.blocks, count * self.number // self.blocks)


def find_block(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    block: Block,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> int:
    """Find the features of a block of the photos; returns the number of these photos. Raises Cancelled."""
    photos = block.of(len(prepared.photos))
    others = len(prepared.photos) - len(photos)

    def report(stage: str, done: int, total: int, note: str) -> None:
        on_progress(stage, done - others, total - others, note)

    with opened(prepared, workdir, options, report, cancelled) as run:
        result = _first_effort(run)
        find_features(run, result, photos)
        completed(result.database, photos)
    return len(photos)


def score_pairs(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    before: Sequence[Path],
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> int:
    """Choose the pairs of photos to match, and keep their scores; returns the number of pairs. Raises Cancelled.

    before: work folders with the features of all blocks. Those that they lack are found, and kept too.
    """
    merge(before, workdir, _merging("features", on_progress), cancelled)
    with opened(prepared, workdir, options, on_progress, cancelled) as run:
        result = _first_effort(run)
        known = photos_in(result.database, with_features=True) if result.database.is_file() else set()
        find_features(run, result)
        chosen = select_pairs(run, result)
        rows = [(*pair, score) for pair, score in run.scores.items()]
        np.savez(result.database.with_name(SCORES), scores=np.array(rows, np.int32).reshape(-1, 3))
        completed(result.database, set(range(run.count)) - known)
    return len(chosen)


def match_block(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    block: Block,
    before: Sequence[Path],
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> int:
    """Match a block of the pairs, and keep nothing else; returns the number of these pairs. Raises Cancelled.

    before: work folders with the features of all blocks, and with the scores.
    """
    merge(before, workdir, _merging("pairs", on_progress), cancelled, without=FEATURES)
    with opened(prepared, workdir, options, on_progress, cancelled) as run:
        result = _first_effort(run)
        chosen = sorted(select_pairs(run, result))  # by the scores, without any features
        own = {chosen[index] for index in block.of(len(chosen))}
        photos = {index for pair in own for index in pair}
        for part in before:
            stop_if(cancelled)
            source = part / result.database.relative_to(workdir)
            if source.is_file() and photos & photos_in(source, with_features=True):
                merge_databases(source, result.database)
        known = photos_in(result.database, with_features=False) if result.database.is_file() else ()
        find_features(run, result, photos if len(known) == run.count else None)
        with closing(pycolmap.Database.open(result.database)) as database:
            match(run, result, own, database)
        result.database.with_name(SCORES).unlink(missing_ok=True)
        completed(result.database, ())
    return len(own)


def map_block(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    block: Block,
    before: Sequence[Path],
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> int:
    """Map a part of the clusters, and keep only their models; returns the number of photos that these place.

    block: the clusters `block.number`, `block.number + block.blocks` and so on, counted from 1.
    before: work folders with the features of all blocks, the scores, and the matches of all blocks. Where matches lack,
        nothing is mapped: they are found once, by `reconstruct_photos`.

    Raises Cancelled.
    """
    merge(before, workdir, _merging("mapping", on_progress), cancelled, without=("descriptors",))
    with opened(prepared, workdir, options, on_progress, cancelled) as run:
        result = _first_effort(run)
        chosen = select_pairs(run, result)  # by the scores, without any features
        models: list[pycolmap.Reconstruction] = []
        if chosen <= pairs_in(result.database):
            find_features(run, result, ())
            with closing(pycolmap.Database.open(result.database)) as database:
                match(run, result, chosen, database)
            models = map_clusters(run, result, lambda count: range(block.number - 1, count, block.blocks))
    result.database.unlink()
    result.database.with_name(SCORES).unlink(missing_ok=True)
    return len({image for model in models for image in model.reg_image_ids()})


def _first_effort(run: SfmRun) -> EffortResult:
    """The effort that is tried first, before it has found anything."""
    effort = efforts(run.options, run.count)[0]
    return EffortResult(effort, database_of(run, effort))


def _merging(stage: str, on_progress: OnProgress) -> Callable[[int, int], None]:
    """Reports the progress of `merge` as that of a stage."""
    return lambda done, total: on_progress(stage, done, total, MERGING)


def merge(
    parts: Sequence[Path],
    workdir: Path,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
    *,
    without: Iterable[str] = (),
) -> None:
    """Bring what the functions above left in the work folders `parts` together in the folder `workdir`.

    on_progress: called with the number of parts that were brought, and of all.
    without: tables of the databases that are left out.

    Raises Cancelled between two parts.
    """
    for number, part in enumerate(parts, 1):
        stop_if(cancelled)
        for source in sorted((part / SFM).glob("*/*/database.db")):
            merge_databases(source, workdir / source.relative_to(part), without=without)
        for source in sorted((part / SFM).glob(f"*/*/{SCORES}")):
            target = workdir / source.relative_to(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        for models in sorted((part / SFM).glob(f"*/*/{CLUSTERS}/*")):
            shutil.copytree(models, workdir / models.relative_to(part), dirs_exist_ok=True)
        on_progress(number, len(parts))

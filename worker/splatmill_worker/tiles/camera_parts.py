"""The units before the cameras, which several processes share: the photos, features of a block of them, the pairs that
may overlap, the matches of a block of pairs, and the mapping of a block of clusters.

They are left out, and the unit `cameras` does all of it, where the cameras are given or known, or where photos lie in
zips and videos, which each of them would have to unpack. Mapping units without a cluster are left out too.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatmill.schema import MIN_PHOTOS, TrainOptions
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, VIDEO_SUFFIXES
from splatmill_worker.images import prepared_file
from splatmill_worker.images.prepare import Prepared, given_files
from splatmill_worker.pipeline.capture import photos_without_cameras, sfm_options
from splatmill_worker.pipeline.events import progress_events
from splatmill_worker.pipeline.job import Job
from splatmill_worker.sfm import blocks
from splatmill_worker.sfm.mapping.clusters import number_of_clusters
from splatmill_worker.sfm.run import SFM
from splatmill_worker.sfm.solve import has_model
from splatmill_worker.tiles.folder import facts_of
from splatmill_worker.tiles.units import CLUSTERS, DIVIDED


def examine_photos(job: Job, out: Path) -> dict[str, Any]:
    """Examine the photos, and leave what was found in `out`, for all later units."""
    if any(path.suffix.lower() in (*ARCHIVE_SUFFIXES, *VIDEO_SUFFIXES) for path in given_files(job.capture)):
        return {DIVIDED: False}
    report = progress_events(job.emit)
    prepared = photos_without_cameras(job.capture, job.workdir, job.options, report, job.cancelled)
    if prepared is None or not prepared_file.can_be_stored(prepared, job.capture):
        return {DIVIDED: False}
    prepared_file.store(prepared, job.capture, out)
    known = has_model(prepared, job.workdir, sfm_options(job.options))
    count = len(prepared.photos)
    return {
        "photos": count,
        DIVIDED: count >= MIN_PHOTOS and not known,
        CLUSTERS: number_of_clusters(count),
    }


def stored_photos(photos: Path, capture: Path) -> Prepared | None:
    """What the unit `photos` has left in the folder `photos`; None where that is nothing."""
    return prepared_file.load(photos, capture) if (photos / prepared_file.FILE).is_file() else None


def has_parts(photos: Path, capture: Path, workdir: Path | None, options: TrainOptions) -> bool:
    """Whether the units after `photos` have something to do: no cameras are given, or known in `workdir`.

    photos: the output of the unit `photos`.
    """
    prepared = stored_photos(photos, capture)
    if prepared is None or not facts_of(photos)[DIVIDED]:
        return False
    return workdir is None or not has_model(prepared, workdir, sfm_options(options))


def files_of_block(photos: Path, block: blocks.Block) -> set[str]:
    """The files of the capture, by their names in it, of which the features of a block are found.

    photos: the output of the unit `photos`.
    """
    capture = Path("/")
    prepared = stored_photos(photos, capture)
    if prepared is None or not facts_of(photos)[DIVIDED]:
        return set()
    own = [prepared.photos[index] for index in block.of(len(prepared.photos))]
    paths = [path for photo in own for path in (photo.path, photo.mask) if path is not None]
    return {path.relative_to(capture).as_posix() for path in paths if not path.is_relative_to(photos)}


def block_of(name: str, parts: int) -> blocks.Block:
    """The block of a unit by its name, which is one of `parts` of its kind."""
    return blocks.Block(int(name.rpartition("-")[2]), parts)


def do_part(
    job: Job, name: str, parts: int, before: Sequence[Path], out: Path, known: Path | None
) -> dict[str, Any]:
    """Do one of the units after `photos`: features, matches and mapping of a block, one of `parts`, or the pairs.

    before: the outputs of the units that it needs, that of `photos` first.
    out: folder for its own.
    known: work folder in which the cameras may lie; None without.
    """
    photos, *others = before
    if job.prepared is None or not has_parts(photos, job.capture, known, job.options):
        return {}
    kind = name.partition("-")[0]
    prepared, options = job.prepared, sfm_options(job.options)
    report, stop = progress_events(job.emit), job.cancelled
    if kind == "pairs":
        facts = {"pairs": blocks.score_pairs(prepared, job.workdir, options, others, report, stop)}
    elif kind == "features":
        block = block_of(name, parts)
        facts = {"photos": blocks.find_block(prepared, job.workdir, options, block, report, stop)}
    elif kind == "mapping":
        block = block_of(name, parts)
        facts = {"photos": blocks.map_block(prepared, job.workdir, options, block, others, report, stop)}
    else:
        block = block_of(name, parts)
        facts = {"pairs": blocks.match_block(prepared, job.workdir, options, block, others, report, stop)}
    shutil.move(job.workdir / SFM, out / SFM)
    return facts

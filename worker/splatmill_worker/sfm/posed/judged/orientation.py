"""Decides whether given cameras are those of the photos as stored, or as their EXIF orientation turns them.

Some programs that estimate cameras apply the orientation, and others do not. The size of the camera says which it was,
unless the photo has the same shape both ways: when it is upside down or mirrored, or square. Then the matches decide.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.errors import Refusal
from splatmill_worker.scene import Scene, View, without
from splatmill_worker.sfm.callbacks import OnProgress
from splatmill_worker.sfm.matching import overlap, two_view
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.options import LEAN
from splatmill_worker.sfm.posed.judged.searched import database_of, epipolar_errors, features_of, model_of
from splatmill_worker.sfm.run import torch_threads

SAMPLE = 16
"""Undecided photos that are matched with others, at most: one program reads all photos in the same way."""

PARTNERS = 4
"""Photos that each of these is matched with."""

CLEARLY = 2.0
"""Factor by which the cameras must explain more matches in one way than in the other. Read the wrong way, they explain
those that lie near their epipolar line by chance."""

FEWEST = 2 * two_view.MIN_INLIERS
"""Explained matches that decide, at least: those of two pairs of photos."""

READINGS = "as stored", "as their EXIF orientation turns them"


def decided(
    scene: Scene,
    *,
    seed: int = 0,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Scene:
    """The scene with each photo read in the way that its camera means; no view has an `other`.

    All undecided photos are read in the way in which the given cameras explain clearly more of the matches. Where
    neither does, they are left out, with a warning.

    Raises Refusal where they would be more than the other photos, OSError and ValueError for photos as `load_view`
    does, and Cancelled.
    """
    undecided = [index for index, view in enumerate(scene.views) if view.other is not None]
    if not undecided:
        return scene
    chosen = np.linspace(0, len(undecided) - 1, min(SAMPLE, len(undecided))).astype(int)
    pairs = overlap.by_overlap(
        [view.camera for view in scene.views], PARTNERS, [undecided[index] for index in chosen]
    )
    with tempfile.TemporaryDirectory() as folder:
        explained, matches = _explained(scene.views, pairs, Path(folder), seed, on_progress, cancelled)
    way = int(np.argmax(explained))
    names = [scene.views[index].name for index in undecided]
    fits = (
        f"The cameras of {len(names)} photos with an EXIF orientation (such as {names[0]}) fit their size both "
        f"{READINGS[0]} and {READINGS[1]}"
    )
    counts = " and ".join(
        f"{count} of {of} matches with other photos {reading}"
        for count, of, reading in zip(explained, matches, READINGS, strict=True)
    )
    if explained[way] >= max(FEWEST, CLEARLY * explained[1 - way]):
        said = f"{fits}. The cameras explain {counts}, so the photos are read {READINGS[way]}."
        views = tuple(_read(view, upright=way == 1) for view in scene.views)
        return replace(scene, views=views, warnings=(*scene.warnings, said))
    said = f"{fits}, and the matches do not decide: the cameras explain {counts}."
    advice = (
        "Give photos without an EXIF orientation: turn their pixels as it says if that is how the program that made "
        "the cameras read them, or only remove it if that program read them as stored."
    )
    if 2 * len(undecided) > len(scene.views):
        raise Refusal("poses_invalid", said, advice=advice)
    scene = without(scene, undecided, "its EXIF orientation is undecided")
    return replace(scene, warnings=(*scene.warnings, f"{said} These photos are left out. {advice}"))


def _read(view: View, *, upright: bool) -> View:
    """A view, read in this way if it is undecided."""
    if view.other is None or not upright:
        return replace(view, other=None)
    return replace(view.other, mask=view.mask, shown_from=view.shown_from, split=view.split)


def _explained(
    views: Sequence[View],
    pairs: set[Pair],
    folder: Path,
    seed: int,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> tuple[list[int], list[int]]:
    """Number of matches that the cameras explain, and of all, with undecided photos as stored and upright."""
    used = sorted({index for pair in pairs for index in pair})
    if not used:
        return [0, 0], [0, 0]
    place = {index: number for number, index in enumerate(used)}
    ordered = sorted((place[first], place[second]) for first, second in pairs)
    stored = [views[index] for index in used]
    other = {number: view.other for number, view in enumerate(stored) if view.other is not None}
    errors: list[npt.NDArray[np.float64]] = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool, torch_threads(1):
        searched = features_of(stored, LEAN, pool, on_progress, cancelled)
        turned = features_of(list(other.values()), LEAN, pool, on_progress, cancelled)
        for upright in (False, True):
            photos = list(searched)
            for number, each in zip(other, turned, strict=True) if upright else ():
                photos[number] = each
            cameras, features = [each.camera for each in photos], [each.features for each in photos]
            path = folder / f"{upright}.db"
            with closing(database_of(path, model_of(cameras), features)) as database:
                matched = two_view.match_pairs(
                    ordered,
                    features,
                    {index: index + 1 for index in range(len(photos))},
                    database,
                    seed,
                    pool,
                    lambda done, total: on_progress("matching", done, total, "pairs matched"),
                    cancelled,
                )
                verified = [pair for pair in ordered if matched[pair].inliers >= two_view.MIN_INLIERS]
                errors.append(epipolar_errors(verified, cameras, features, database, in_front=True))
    side = max(max(each.camera.width, each.camera.height) for each in searched)
    # Cameras that are less exact than matches explain them within their own error, in the right way.
    medians = [float(np.median(each)) for each in errors if len(each)]
    bound = max(two_view.max_error(side), min(medians, default=0.0))
    if not np.isfinite(bound):
        bound = two_view.max_error(side)
    return [int((each <= bound).sum()) for each in errors], [len(each) for each in errors]

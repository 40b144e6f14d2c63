"""Whether the photos show the points of a scan where they lie, and which of these are used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, PointViews, Scene, View
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.alignment import Unaligned, align
from splatmill_worker.sfm.callbacks import OnProgress
from splatmill_worker.splat.plan import capacity

STARTED = 0.2
"""Share of the Gaussians that the photos resolve which a scan gives, at most (decisions: scan-points)."""

FEW = 20_000
"""Points of a scan that are used in any case."""

LEAST_SHARE = 0.5
"""Share of the agreement of the scene's own points with the photos, above chance, that an aligned scan has at least
(decisions: scan-agreement)."""

LEAST_SHOWN = 20
"""Points of a scan that photos show at different places, and of the scene, below which nothing can be said."""

Colors = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Alignment:
    """How a scan was brought to the scene, for the report.

    share: of the points of the scene that lie on the scan.
    residual: median distance of these from the scan, in units of the scan.
    scale: length in the scene of one unit of the scan.
    matrix: 4x4 by rows, from the coordinates of the scan to those of the scene.
    """

    share: float
    residual: float
    scale: float
    matrix: list[list[float]]


@dataclass(frozen=True)
class Fit:
    """The points of a scan in a scene.

    points: those that are used [n,3], in the scene's coordinates; none where they do not fit.
    colors: of these, from the photos where the scan has none [n,3].
    resolved: number of points that were left by what the photos resolve.
    pixels: of the closest photo for one of these.
    sentence: what the photos say of them, with the numbers.
    alignment: how they came there; None where they lay there.
    """

    points: Float
    colors: Colors
    resolved: int
    pixels: float
    sentence: str
    alignment: Alignment | None = None

    @property
    def fits(self) -> bool:
        """Whether any point is used."""
        return len(self.points) > 0


def as_it_lies(
    scene: Scene,
    points: Float,
    colors: Colors,
    side: int | None,
    cancelled: Callable[[], bool],
    *,
    from_photos: bool = False,
) -> Fit:
    """The points of a scan in the coordinates of the scene's cameras, judged by the photos as aligned ones are; where
    the scene has no points of its own, or the scan no colours, as points that come with a data set are.

    points, colors: of the scan [n,3].
    side: pixels of the longest side of the photos that are trained on; None: their full size.
    from_photos: whether each colour is that of one of the photos, which then says nothing of its point.
    """
    views = [view for view in scene.views if view.split != "test"]
    rows, pixels = posed.resolved(points, posed.footprints(points, views, side, cancelled), most(views, side))
    if len(rows) < LEAST_SHOWN:
        said = f"The photos show {len(rows)} of its points apart from each other."
        return _none(said)
    plain = bool((colors == colors[0]).all())
    if from_photos or (not plain and len(scene.points) >= LEAST_SHOWN):
        kept, said = _shown(scene, points[rows], colors[rows], cancelled, int(from_photos))
        return Fit(points[rows][kept], colors[rows][kept], len(rows), pixels, said)
    judged = posed.with_loose_points(
        replace(
            scene, points=points[rows], colors=colors[rows], point_views=None, point_errors=None, notes=()
        ),
        cancelled,
    )
    return Fit(judged.points, judged.colors, len(rows), pixels, " ".join(judged.notes))


def aligned(
    scene: Scene,
    points: Float,
    colors: Colors,
    side: int | None,
    seed: int,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Fit:
    """The points of a scan brought onto the scene's own by a similarity, if the photos then show their colours.

    How often photos show the colours of the scene's own points, above chance, says what can be expected. A scan without
    colours is not aligned: where it lies wrong, photos agree on the colours at its places nearly as well.

    Raises Cancelled.
    """
    if (colors == colors[0]).all():
        return _none("They have no colours, by which they could be aligned to the points of the photos.")
    alignment = align(
        points,
        colors,
        scene.points,
        scene.colors,
        seed=seed,
        on_progress=on_progress,
        cancelled=cancelled,
    )
    if isinstance(alignment, Unaligned):
        return _none(f"They could not be aligned to the points of the photos: {alignment.reason}.")
    views = [view for view in scene.views if view.split != "test"]
    moved = alignment.similarity.points(points)
    rows, pixels = posed.resolved(moved, posed.footprints(moved, views, side, cancelled), most(views, side))
    how = Alignment(
        round(alignment.share, 4),
        alignment.residual,
        alignment.similarity.scale,
        alignment.similarity.matrix.tolist(),
    )
    said = (
        f"Aligned as well as they can be, {100 * alignment.share:.0f} % of the points of the photos lie on them, half "
        f"of these within {alignment.residual:.3g} of the file's units."
    )
    if len(rows) < LEAST_SHOWN:
        return _none(f"{said} The photos show {len(rows)} of them apart from each other.", how)
    moved, own = moved[rows], colors[rows]
    kept, sentence = _shown(scene, moved, own, cancelled)
    return Fit(moved[kept], own[kept], len(rows), pixels, f"{said} {sentence}", how)


def _none(sentence: str, alignment: Alignment | None = None) -> Fit:
    return Fit(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0, 1.0, sentence, alignment)


def _shown(
    scene: Scene, points: Float, colors: Colors, cancelled: Callable[[], bool], own: int = 0
) -> tuple[npt.NDArray[np.bool_], str]:
    """Which points [n,3] photos show in their colours; none, unless they do so about as often as the scene's own, or
    where it has none, more often than by chance.

    own: number of photos that each colour is from, which do not count.
    """
    views = [view for view in scene.views if view.split != "test"]
    evidence = posed.evidence_of(points, colors, views, cancelled)
    shown, agreeing = (np.maximum(counts - own, 0) for counts in (evidence.shown, evidence.agreeing))
    agreement = float(agreeing.sum() / max(1, shown.sum()))
    said = (
        f"{'The other photos' if own else 'The photos'} show their colours at {100 * agreement:.0f} % of the places, "
        f"exchanged colours at {100 * evidence.chance:.0f} %"
    )
    if len(scene.points) < LEAST_SHOWN:
        fits = not posed.by_chance(agreement, evidence.chance)
        return (agreeing > 0) & evidence.inside & fits, f"{said}."
    reference = posed.evidence_of(*_some(scene), views, cancelled)
    above_chance = agreement - evidence.chance
    fits = above_chance > LEAST_SHARE * max(0.0, reference.agreement - reference.chance)
    return (agreeing > 0) & evidence.inside & fits, (
        f"{said}; those of the points of the photos, at {100 * reference.agreement:.0f} % "
        f"and {100 * reference.chance:.0f} %."
    )


def joined(scene: Scene, fit: Fit) -> Scene:
    """The scene with the points that are used behind its own."""
    return replace(
        scene,
        points=np.concatenate([scene.points, fit.points]),
        colors=np.concatenate([scene.colors, fit.colors]),
        **_tracks(scene, fit),
    )


def _tracks(scene: Scene, fit: Fit) -> dict[str, Any]:
    """The tracks of the scene's points and of those of the scan after them; none where the scene's are not known, since
    those of the scan alone would mean that no photo shows the others."""
    if scene.point_views is None:
        return {"point_views": None, "point_errors": None, "track_lengths": None}
    added = point_views(scene, fit.points)
    offsets, views = scene.point_views
    offsets = np.concatenate([offsets, offsets[-1] + added.offsets[1:]])
    errors = scene.point_errors
    return {
        "point_views": PointViews(offsets, np.concatenate([views, added.views])),
        "point_errors": None if errors is None else np.append(errors, np.full(len(fit.points), np.nan)),
        "track_lengths": np.diff(offsets).astype(np.int32),
    }


def most(views: Sequence[View], side: int | None) -> int:
    """Points of a scan that are used at most with these photos, whose longest side is reduced to `side`."""
    pixels = 0.0
    for view in views:
        camera = view.camera
        reduced = 1.0 if side is None else min(1.0, side / max(camera.width, camera.height))
        pixels += reduced**2 * camera.width * camera.height
    return min(posed.MOST_LOOSE, max(FEW, round(STARTED * capacity.resolved(pixels, 1))))


def point_views(scene: Scene, points: Float) -> PointViews:
    """The views that see points [n,3], as far as these hide each other; test views of a data set take no part."""
    rows, views = [np.zeros(0, np.intp)], [np.zeros(0, np.int32)]
    for index, view in enumerate(scene.views):
        if view.split != "test":
            visible = posed.visible(view.camera, view.camera.project(points))
            rows.append(visible)
            views.append(np.full(len(visible), index, np.int32))
    of_point = np.concatenate(rows)
    order = np.argsort(of_point, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(of_point, minlength=len(points)))]).astype(np.int64)
    return PointViews(offsets, np.concatenate(views)[order])


def _some(scene: Scene, most: int = 5_000) -> tuple[Float, Colors]:
    """The points of the scene and their colours, or some of them, evenly chosen."""
    stride = max(1, -(-len(scene.points) // most))
    return scene.points[::stride], scene.colors[::stride]

"""Points of scenes whose cameras were given: the given ones where photos confirm them, or else found with the cameras.

What is tried, in this order: given points with tracks; given points without tracks, judged by their colours in the
photos; features triangulated with the cameras as they are; a plane sweep (`stereo`), which comes before the features
where photos are transparent. Where all of it fails, `facts["no_points"]` of the scene says why.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatmill.files import replacing
from splatmill_worker.colmap import pycolmap
from splatmill_worker.opencv import VERSION as OPENCV_VERSION
from splatmill_worker.scene import PointViews, Scene, Source
from splatmill_worker.sfm import stereo
from splatmill_worker.sfm.callbacks import OnProgress
from splatmill_worker.sfm.matching import two_view
from splatmill_worker.sfm.options import LEAN, STANDARD
from splatmill_worker.sfm.posed.judged import conventions, orientation
from splatmill_worker.sfm.posed.judged.evidence import Evidence, evidence_of
from splatmill_worker.sfm.posed.judged.triangulation import Triangulated, contradicted, triangulate
from splatmill_worker.sfm.posed.judged.uncolored import seen_in

VERSION = 3
"""Version of the method; points stored under another version are searched for anew."""

LEAST_POINTS = 20
"""Points below which a scene counts as one without points."""

LEAST_OBSERVATIONS = 20.0
"""Mean number of points per photo below which given points are not relied on, and triangulated ones replace them."""

FEW_OBSERVATIONS = 100.0
"""Mean number of triangulated points per photo below which more features are searched for."""

MOST_LOOSE = 200_000
"""Given points without tracks that are used, at most: a laser scan has more than a model has Gaussians."""

ABOVE_CHANCE = 1.25
"""Factor by which photos must show the colours of given points more often than exchanged colours."""

PLAIN = 0.5
"""Share of the photos that show a point's colour from which it does not matter that others would agree as well: in a
scene of one colour, all do."""

OWN_PHOTOS = 0.5
"""Share of the photos named by tracks that show the colours of their points, below which they may be exchanged ones
(decisions: OWN_PHOTOS)."""

CHECKED = 24
"""Photos in which the colours of points with tracks are compared, at most."""

LOOKED_AT = 4
"""Photos that tell whether a data set has transparent ones: this many, and less than twice as many."""


def with_points(
    scene: Scene,
    workdir: Path,
    *,
    seed: int = 0,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Scene:
    """The scene with the points that its photos confirm or give; what was found is kept in `workdir`.

    No camera is moved. Where photos are transparent, the plane sweep comes first, and features are searched for only if
    it finds little: it serves cut-outs as well, in a quarter of the time (decisions: hull-start).

    Raises OSError and ValueError for photos as `images.load_view` does, Refusal as `orientation.decided` does, and
    Cancelled.
    """
    scene = orientation.decided(scene, seed=seed, on_progress=on_progress, cancelled=cancelled)
    scene = with_loose_points(scene, cancelled)
    if not _lacks_points(scene):
        if _shows_others(scene, cancelled):
            triangulation = _search(scene, workdir, seed, on_progress, cancelled)
            scene = replace(scene, warnings=(*scene.warnings, *_contradiction(scene, triangulation)))
        return _with_stereo(scene, workdir, on_progress, cancelled)
    if _transparent(scene, cancelled):
        swept = _with_stereo(scene, workdir, on_progress, cancelled)
        if not _lacks_points(swept):
            return swept
    triangulation = _search(scene, workdir, seed, on_progress, cancelled)
    scene = _with_triangulated(scene, triangulation, cancelled)
    scene = _with_stereo(scene, workdir, on_progress, cancelled)
    if len(scene.points) >= LEAST_POINTS:
        return scene
    return replace(scene, facts=scene.facts | {"no_points": _failure(scene, triangulation)})


def with_loose_points(scene: Scene, cancelled: Callable[[], bool]) -> Scene:
    """The scene with those of its points without tracks that some photo shows in their colour.

    None are kept where photos show the colours hardly more often than exchanged ones: the points then lie in another
    frame than the cameras. Points that all have one colour get the median of the photos that see them; none are kept
    where the photos agree on these no more than by chance.
    """
    count = len(scene.points)
    if scene.point_views is not None or not count:
        return scene
    stride = -(-count // MOST_LOOSE)
    points, colors = scene.points[::stride], scene.colors[::stride]
    views = [view for view in scene.views if view.split != "test"]
    evidence = evidence_of(points, colors, views, cancelled)
    plain = bool((colors == colors[0]).all())
    appearance = seen_in(points, views, cancelled) if plain else None
    kept = evidence.agreeing > 0 if appearance is None else appearance.counts > 0
    kept &= evidence.inside
    note = _loose_note(count, len(points), int(kept.sum()), evidence, plain)
    if appearance is not None and appearance.contradicted:
        kept[:] = False
        note = (
            f"The {count} points that came without tracks and without colours are not used: at their places, the "
            f"photos differ by {appearance.spread:.0f} levels of 255, and at exchanged places by "
            f"{appearance.by_chance:.0f}. Their coordinates are probably not those of the cameras."
        )
    elif appearance is None and _elsewhere(evidence):
        kept[:] = False
        note = (
            f"The {count} points that came without tracks are not used: the photos show their colours at "
            f"{100 * evidence.agreement:.0f} % of the places, and exchanged colours at {100 * evidence.chance:.0f} %. "
            "Their coordinates are probably not those of the cameras."
        )
    return replace(
        scene,
        points=points[kept],
        colors=(colors if appearance is None else appearance.colors)[kept],
        notes=(*scene.notes, note),
        facts=scene.facts
        | {
            "loose_points": count,
            "loose_points_used": int(kept.sum()),
            "transparent_photos": evidence.transparent,
        },
    )


def _elsewhere(evidence: Evidence) -> bool:
    unseen = float((evidence.shown == 0).mean())
    return unseen > 0.5 or by_chance(evidence.agreement, evidence.chance)


def by_chance(agreement: float, chance: float) -> bool:
    """Whether photos show the colours of points hardly more often than exchanged ones."""
    return not (agreement >= PLAIN or agreement > ABOVE_CHANCE * chance)


def _shows_others(scene: Scene, cancelled: Callable[[], bool]) -> bool:
    """Whether the photos show the colours of fewer than OWN_PHOTOS of the points whose tracks name them, so that the
    cameras or the points may be those of other photos; also where they show none. Some photos are compared."""
    if scene.point_views is None or (scene.colors == scene.colors[0]).all():
        return False
    owners = np.repeat(np.arange(len(scene.points)), np.diff(scene.point_views.offsets))
    used = [index for index, view in enumerate(scene.views) if view.split != "test"]
    shown, agreeing = 0, 0
    for index in used[:: -(-len(used) // CHECKED)]:
        rows = owners[scene.point_views.views == index]
        evidence = evidence_of(scene.points[rows], scene.colors[rows], [scene.views[index]], cancelled)
        shown += int(evidence.shown.sum())
        agreeing += int(evidence.agreeing.sum())
    return agreeing < OWN_PHOTOS * max(1, shown)


def _loose_note(count: int, judged: int, kept: int, evidence: Evidence, plain: bool) -> str:
    unseen = int((evidence.shown == 0).sum())
    through = int((~evidence.inside).sum())
    thinned = "" if judged == count else f" Every {-(-count // judged)}th was taken, {judged} in all."
    why = "their colours were read from the photos" if plain else "photos show their colours"
    return (
        f"{count} points came without tracks.{thinned} {kept} of them are used, since {why}; of the others, no photo "
        f"shows {unseen}, and {through} lie where a photo is transparent."
    )


def _lacks_points(scene: Scene) -> bool:
    few = len(scene.points) < LEAST_POINTS or stereo.observations_per_view(scene) < LEAST_OBSERVATIONS
    return few and sum(view.split != "test" for view in scene.views) >= 2


def _transparent(scene: Scene, cancelled: Callable[[], bool]) -> bool:
    """Whether some of a few photos, evenly chosen, have transparent pixels."""
    views = [view for view in scene.views if view.split != "test"]
    some = views[:: max(1, len(views) // LOOKED_AT)]
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return evidence_of(*nothing, some, cancelled).transparent > 0


def _search(
    scene: Scene, workdir: Path, seed: int, on_progress: OnProgress, cancelled: Callable[[], bool]
) -> Triangulated:
    """What triangulation finds, kept in `workdir`."""
    stored = workdir / "sfm" / f"triangulated-{_digest(scene)}-{seed}.npz"
    if not stored.is_file():
        _save(_searched(scene, seed, on_progress, cancelled), stored)
    return _load(stored)


def _searched(
    scene: Scene, seed: int, on_progress: OnProgress, cancelled: Callable[[], bool]
) -> Triangulated:
    """What triangulation finds, with more features where the first ones give few points."""
    views = [view for view in scene.views if view.split != "test"]
    first = triangulate(
        views, LEAN, source=scene.source, seed=seed, on_progress=on_progress, cancelled=cancelled
    )
    if sum(map(len, first.tracks)) >= FEW_OBSERVATIONS * len(views) or contradicted(
        first.agreeing, first.matches
    ):
        return first
    again = triangulate(
        views, STANDARD, source=scene.source, seed=seed, on_progress=on_progress, cancelled=cancelled
    )
    spent = {stage: again.seconds[stage] + first.seconds[stage] for stage in again.seconds}
    return replace(again if len(again.points) > len(first.points) else first, seconds=spent)


def _with_triangulated(scene: Scene, triangulation: Triangulated, cancelled: Callable[[], bool]) -> Scene:
    """The scene with the triangulated points in place of its own few, and what is to be said about them."""
    used = [index for index, view in enumerate(scene.views) if view.split != "test"]
    kept = np.flatnonzero(
        evidence_of(
            triangulation.points, triangulation.colors, [scene.views[index] for index in used], cancelled
        ).inside
    )
    tracks = [triangulation.tracks[row] for row in kept]
    lengths = np.array([len(track) for track in tracks], np.int32)
    own = len(scene.points)
    facts = {
        "triangulated_points": len(kept),
        "matches": triangulation.matches,
        "verified_pairs": triangulation.pairs,
        "matches_explained_by_cameras": round(triangulation.agreeing / max(1, triangulation.matches), 4),
        "cameras_contradicted": contradicted(triangulation.agreeing, triangulation.matches),
        "match_error_px": None if not triangulation.matches else round(triangulation.disagreement, 3),
        "features_per_photo": triangulation.features,
        "transparent_photos": triangulation.transparent,
        "seconds": triangulation.seconds,
    }
    messages = [_triangulated_note(own, len(kept), triangulation)]
    warnings = [*scene.warnings, *_contradiction(scene, triangulation)]
    if len(kept) < LEAST_POINTS or len(kept) <= own:
        return replace(
            scene, facts=scene.facts | facts, notes=(*scene.notes, *messages), warnings=tuple(warnings)
        )
    return replace(
        scene,
        points=triangulation.points[kept],
        colors=triangulation.colors[kept],
        point_errors=triangulation.errors[kept],
        track_lengths=lengths,
        point_views=PointViews(
            np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
            np.array([used[index] for track in tracks for index in track], np.int32),
        ),
        facts=scene.facts | facts,
        notes=(*scene.notes, *messages),
        warnings=tuple(warnings),
    )


def _contradiction(scene: Scene, triangulation: Triangulated) -> list[str]:
    """A warning where the cameras explain few of the matches; else none."""
    if not contradicted(triangulation.agreeing, triangulation.matches):
        return []
    return [
        f"The given cameras explain only {100 * triangulation.agreeing / triangulation.matches:.0f} % of the "
        f"{triangulation.matches} matches between the photos; half of them are off by "
        f"{triangulation.disagreement:.1f} pixels or more. The poses or the intrinsics are "
        "wrong, or belong to other photos: correct them, or remove them to have the cameras recovered from the photos."
        + _suggestion(scene.source, triangulation)
    ]


def _suggestion(source: Source, triangulation: Triangulated) -> str:
    """What to do where the cameras fit the photos in another convention; else ""."""
    if not triangulation.convention:
        return ""
    return (
        f" Read as matrices {triangulation.convention}, they explain {100 * triangulation.convention_share:.0f} %: "
        f"{conventions.of_source(source)}. Convert them."
    )


def _triangulated_note(own: int, kept: int, triangulation: Triangulated) -> str:
    had = "no points" if not own else f"only {own} points"
    said = f"The cameras came with {had}. "
    if not triangulation.matches:
        return said + "No points could be triangulated: no two photos match."
    return said + (
        f"{kept} points were triangulated with them in {sum(triangulation.seconds.values()):.1f} seconds; they explain "
        f"{100 * triangulation.agreeing / triangulation.matches:.0f} % of {triangulation.matches} matches "
        f"between {triangulation.pairs} pairs of photos, and half of the matches are off by "
        f"{triangulation.disagreement:.2f} pixels or less."
    )


def _failure(scene: Scene, triangulation: Triangulated) -> str:
    """Why there are no points, for the plan."""
    if triangulation.features < 2 * two_view.MIN_INLIERS:
        return (
            f"Half of the photos have at most {triangulation.features:.0f} features, too few to be matched."
        )
    if not triangulation.matches:
        return "No two photos match, so nothing could be triangulated with the given cameras."
    if contradicted(triangulation.agreeing, triangulation.matches):
        return (
            f"The given cameras explain only {100 * triangulation.agreeing / triangulation.matches:.0f} % of the "
            "matches between the photos, so nothing could be triangulated."
        )
    return f"Only {len(triangulation.points)} points could be triangulated with the given cameras."


def _with_stereo(
    scene: Scene, workdir: Path, on_progress: OnProgress, cancelled: Callable[[], bool]
) -> Scene:
    if not stereo.has_few_points(scene):
        return scene
    stored = workdir / "sfm" / f"posed-{_digest(scene)}.npz"
    return stereo.with_stereo_points(scene, stored, on_progress, cancelled)


def _save(triangulation: Triangulated, path: Path) -> None:
    """Write the result to the .npz file `path`, atomically."""
    values: dict[str, Any] = asdict(triangulation)
    lengths = np.array([len(track) for track in triangulation.tracks], np.int64)
    values["tracks"] = np.array([index for track in triangulation.tracks for index in track], np.int64)
    values["seconds"] = json.dumps(triangulation.seconds)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **values, lengths=lengths)


def _load(path: Path) -> Triangulated:
    """The result that `_save` wrote."""
    with np.load(path) as stored:
        ends = np.cumsum(stored["lengths"])[:-1]
        split = np.split(stored["tracks"], ends) if len(stored["lengths"]) else []
        values = {field.name: stored[field.name] for field in fields(Triangulated)}
        values["tracks"] = tuple(tuple(int(index) for index in track) for track in split)
        values["seconds"] = json.loads(str(stored["seconds"]))
        for name, value in values.items():
            if isinstance(value, np.ndarray) and value.ndim == 0:
                values[name] = value.item()
        return Triangulated(**values)


def _digest(scene: Scene) -> str:
    """A name for everything that found points depend on: the method, cameras, known points and masks."""
    digest = hashlib.sha256(
        repr((VERSION, stereo.VERSION, pycolmap.__version__, OPENCV_VERSION, scene.points.shape)).encode()
    )
    digest.update(scene.points.tobytes())
    for view in scene.views:
        camera = view.camera
        size = camera.width, camera.height
        digest.update(repr((view.name, view.lens, view.split, view.upright, *size)).encode())
        digest.update(camera.viewmat.tobytes() + camera.K.tobytes())
        if view.mask is not None:
            digest.update(hashlib.sha256(view.mask.read_bytes()).digest() + bytes([view.shown_from]))
    return digest.hexdigest()[:24]

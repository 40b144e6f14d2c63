"""Points found by stereo: their file, and a scene with them added."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill.files import replacing
from splatmill_worker.scene import PointViews, Scene

Float = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StereoPoints:
    """Points that stereo adds to those of a scene.

    points: positions in the world [n,3].
    colors: RGB [n,3].
    errors: mean disagreement of the photos, in pixels of the full-size photos [n].
    views: numbers of the views that show the points, those of each point in order, as in `PointViews`.
    offsets: where those of each point begin, and the end [n+1].
    seconds: time that the search took.
    given_up: whether the search ended without points, because hardly any patch of its first photos was found again.
    """

    points: Float
    colors: npt.NDArray[np.uint8]
    errors: Float
    views: npt.NDArray[np.int32]
    offsets: npt.NDArray[np.int64]
    seconds: float
    given_up: bool

    def save(self, path: Path) -> None:
        """Write the points to the .npz file `path`, atomically."""
        with replacing(path) as part, part.open("wb") as file:
            np.savez(file, **vars(self))

    @staticmethod
    def load(path: Path) -> StereoPoints:
        """The points that `save` wrote to `path`."""
        with np.load(path) as stored:
            return StereoPoints(
                stored["points"],
                stored["colors"],
                stored["errors"],
                stored["views"],
                stored["offsets"],
                float(stored["seconds"]),
                bool(stored["given_up"]),
            )


def observations_per_view(scene: Scene) -> float:
    """Mean number of points that a photo shows: by the tracks, or without tracks by projecting the points."""
    if not scene.views:
        return 0.0
    if scene.point_views is not None:
        return len(scene.point_views.views) / len(scene.views)
    return float(np.mean([view.camera.project(scene.points).inside.sum() for view in scene.views]))


def add(scene: Scene, added: StereoPoints) -> Scene:
    """The scene with the stereo points after its own, the facts about them, and a note for the user.

    Own points without errors get NaN. Without tracks of the own points, the result has no tracks at all: tracks of the
    stereo points alone would mean that no photo shows the others.
    """
    count, known = len(added.points), len(scene.points)
    facts = scene.facts | {
        "points": known + count,
        "sparse_points": known,
        "stereo_points": count,
        "stereo_seconds": round(added.seconds, 3),
        "sightings_per_view": round(observations_per_view(scene), 1),
    }
    sparse = f"A photo shows {facts['sightings_per_view']:.0f} of the {known} points on average"
    if known == 0:
        sparse = "The cameras came without points"
    if added.given_up:
        note = f"{sparse}. Stereo added none: hardly any patch of the photos was found in their neighbours."
    else:
        note = f"{sparse}. Stereo added {count} points in {added.seconds:.1f} seconds."
    errors = scene.point_errors if scene.point_errors is not None else np.full(known, np.nan)
    own = scene.point_views
    if own is None and known == 0:
        own = PointViews(np.zeros(1, np.int64), np.zeros(0, np.int32))
    return replace(
        scene,
        points=np.concatenate([scene.points, added.points]),
        colors=np.concatenate([scene.colors, added.colors]),
        point_errors=np.concatenate([errors, added.errors]),
        track_lengths=None
        if own is None
        else np.concatenate([np.diff(own.offsets), np.diff(added.offsets)]).astype(np.int32),
        point_views=None
        if own is None
        else PointViews(
            np.concatenate([own.offsets, own.offsets[-1] + added.offsets[1:]]),
            np.concatenate([own.views, added.views]),
        ),
        facts=facts,
        notes=(*scene.notes, note),
    )

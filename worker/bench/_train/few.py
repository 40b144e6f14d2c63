"""Captures with few photos: scenes of many, with only some to train on. Photos are linked, never copied."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatmill_worker.scene import PointViews, Scene, View
from splatmill_worker.sfm.posed.written import model_of

COUNTS = (9, 16)
"""Training photos that are left: as many as kermit has, and more than FEW_VIEWS."""

HELD_OUT = {"fox": 7, "lund": 4, "synthetic": 5, "beer": 9, "snowmiku": 12, "unequal": 5, "tone-mapped": 5}
"""The scenes, and their held-out photos, all of which are kept. Those with points and more than 16 training photos."""

SCENES = {f"{whole}-{count}": (whole, count) for whole in HELD_OUT for count in COUNTS}
"""The whole scene and the number of training photos of each."""


def held_out(name: str) -> list[str]:
    """The names of the held-out photos in a capture of SCENES."""
    whole, _ = SCENES[name]
    return [f"held-out-{at:02d}.jpg" for at in range(HELD_OUT[whole])]


def make(name: str, capture: Path, scene: Scene, train: Sequence[View], test: Sequence[View]) -> None:
    """Write the capture of one of SCENES to the new folder `capture`.

    scene, train, test: the whole scene, its training photos and its held-out ones. The training photos are thinned out
    evenly in order of name. Of the points, those stay that two of them or more see, at the places that they have in the
    whole scene; what only held-out photos see is gone.

    Raises ValueError, as a sentence, for other numbers of photos than SCENES and HELD_OUT say.
    """
    _, count = SCENES[name]
    kept_out = held_out(name)
    if len(train) <= count or len(test) != len(kept_out):
        raise ValueError(
            f"{name} is made of more than {count} training photos and {len(kept_out)} held-out ones; "
            f"the whole scene has {len(train)} and {len(test)}."
        )
    chosen = [train[int((at + 0.5) * len(train) / count)] for at in range(count)]
    part = capture.with_name("capture.part")
    shutil.rmtree(part, ignore_errors=True)
    for folder in ("images", "poses"):
        (part / folder).mkdir(parents=True)
    names = [*(f"train-{at:02d}.jpg" for at in range(count)), *kept_out]
    views = [replace(view, name=name) for name, view in zip(names, (*chosen, *test), strict=True)]
    for view in views:
        (part / "images" / view.name).symlink_to(view.image.resolve())
    thinned = _thinned(scene, chosen)
    model_of(views, thinned.points, thinned).write_binary(part / "poses")
    part.rename(capture)


def _thinned(scene: Scene, chosen: Sequence[View]) -> Scene:
    """`scene` with the views `chosen` alone, and the points that at least two of them see."""
    assert scene.point_views is not None
    places = {view.name: at for at, view in enumerate(chosen)}
    renumbered = np.array([places.get(view.name, -1) for view in scene.views], np.int32)
    tracks = [
        track[track >= 0]
        for track in np.split(renumbered[scene.point_views.views], scene.point_views.offsets[1:-1])
    ]
    kept = np.array([len(track) >= 2 for track in tracks])
    tracks = [track for track, keep in zip(tracks, kept, strict=True) if keep]
    lengths = np.array([len(track) for track in tracks], np.int32)
    return replace(
        scene,
        views=tuple(chosen),
        points=scene.points[kept],
        colors=scene.colors[kept],
        point_errors=None if scene.point_errors is None else scene.point_errors[kept],
        track_lengths=lengths,
        point_views=PointViews(
            np.concatenate([[0], np.cumsum(lengths)]), np.concatenate([*tracks, np.zeros(0, np.int32)])
        ),
    )

"""What a job shows of itself while it runs, to those who look: cameras as they are placed, the scene in training.

A job pays for this only while somebody looks. Structure from motion and training wait while they are looked at; the
seconds are counted, and the training clock stands still.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from splatmill.files import atomic_write
from splatmill.schema import CamerasEvent, Event, PlacedCamera, Placement, SnapshotEvent, UnusedPhoto
from splatmill_worker.scene import Camera, Scene
from splatmill_worker.sfm.placed import Placed
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.formats import compressed_ply
from splatmill_worker.splat.formats.contents import MIN_OPACITY
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.report.export import ExportWorld, spec_of
from splatmill_worker.splat.train.run import TrainingRun

INTERVAL = 2.0
"""Fewest seconds between two looks."""

SHARE = 0.02
"""Largest share of the time that looking takes: the next look waits the longer, the longer the last one took."""

MOST_GAUSSIANS = 500_000
"""Gaussians of a snapshot, 8 MB; of a larger scene, it has those that cover the most."""

MOST_POINTS = 5_000
"""Points of a placement; of more, an even choice."""

PLACEMENT = "placement.json"
"""Name of the stored placement in the folder of a run."""


class Onlookers(Protocol):
    """Those who look at a job while it runs. Neither method waits for them."""

    def are_there(self) -> bool:
        """Whether anybody looks now."""

    def show(self, ply: bytes, event: SnapshotEvent) -> None:
        """Hand a snapshot of the scene to them, and announce it by `event`."""


class Looks:
    """When the next look is due, and what the looks cost.

    seconds: wall time of all looks so far.
    """

    def __init__(self, onlookers: Onlookers) -> None:
        self.onlookers = onlookers
        self.seconds = 0.0
        self._next = 0.0

    def is_due(self) -> bool:
        """Whether to look now: somebody is there, and the last look is long enough ago."""
        return time.monotonic() >= self._next and self.onlookers.are_there()

    @contextmanager
    def one(self) -> Iterator[None]:
        """Count the time inside as a look."""
        started = time.perf_counter()
        try:
            yield
        finally:
            taken = time.perf_counter() - started
            self.seconds += taken
            self._next = time.monotonic() + max(INTERVAL, taken / SHARE)


class LiveCameras:
    """Observes structure from motion, and shows the cameras and points placed so far.

    emit: called with each event.
    workdir: folder of the run; the placement is written to `PLACEMENT` in it.
    """

    def __init__(self, looks: Looks, emit: Callable[[Event], None], workdir: Path) -> None:
        self._looks, self._emit, self._workdir = looks, emit, workdir

    def is_due(self) -> bool:
        """Whether to show the mapping now."""
        return self._looks.is_due()

    def observe(self, look: Callable[[], Placed]) -> None:
        """Show the cameras and points that are placed so far."""
        with self._looks.one():
            placed = look()
            cameras = [_placed_camera(name, camera, None) for name, camera in placed.cameras]
            points, _ = _chosen(placed.points)
            document = Placement(
                final=False, cameras=cameras, points=points, colors=[], points_total=len(placed.points)
            )
            store_placement(document, self._workdir, self._emit)


class LiveScene:
    """Observes training, and shows the scene as a compressed .ply without spherical harmonics.

    world: the coordinates of the snapshots, those of the exported model.
    antialiased: whether the scene is trained antialiased.
    """

    def __init__(self, looks: Looks, world: ExportWorld, antialiased: bool) -> None:
        self._looks, self._world, self._antialiased = looks, world, antialiased

    def is_due(self, run: TrainingRun) -> bool:
        """Whether to show the scene now."""
        return self._looks.is_due()

    def observe(self, run: TrainingRun) -> None:
        """Show the scene as it is."""
        with self._looks.one():
            scene = gaussians_of(run.engine)
            show_scene(
                self._looks.onlookers,
                scene.padded(0),
                self._world,
                count=scene.count,
                antialiased=self._antialiased,
                step=run.state.step,
                seconds=run.clock.seconds,
            )


def show_scene(
    onlookers: Onlookers,
    scene: Gaussians,
    world: ExportWorld,
    *,
    count: int,
    antialiased: bool,
    step: int,
    seconds: float,
) -> None:
    """Show a scene of degree 0 in the training world, or of its Gaussians those that cover the most.

    world: the coordinates in which it is shown.
    count: of all its Gaussians, of which `scene` may have a part.
    step, seconds: of its training so far.
    """
    shown = world.gaussians(most_covering(scene, MOST_GAUSSIANS))
    ply = compressed_ply.encode(shown, antialiased=antialiased)
    onlookers.show(
        ply,
        SnapshotEvent(step=step, seconds=seconds, gaussians=count, shown=shown.count, bytes=len(ply)),
    )


def most_covering(gaussians: Gaussians, limit: int) -> Gaussians:
    """The visible ones among `gaussians`; at most `limit`, those with the largest opacity times area."""
    visible = torch.sigmoid(gaussians.logit_opacities) >= MIN_OPACITY
    gaussians = gaussians.select(gaussians.finite() & visible)
    if gaussians.count <= limit:
        return gaussians
    area = gaussians.log_scales.sort(dim=1).values[:, 1:].sum(dim=1)  # of the largest cross-section
    weight = torch.nn.functional.logsigmoid(gaussians.logit_opacities) + area
    return gaussians.select(torch.topk(weight, limit).indices.sort().values)


def placement_of(scene: Scene, world: ExportWorld, held_out: Iterable[str]) -> Placement:
    """The cameras and points that training uses, in the coordinates of the exported model.

    held_out: names of the photos that are not trained on.
    """
    test = set(held_out)
    points, chosen = _chosen(scene.points - world.offset)
    return Placement(
        final=True,
        cameras=[
            _placed_camera(
                view.name,
                view.camera.moved_to(view.camera.center - world.offset),
                "test" if view.name in test else "train",
            )
            for view in scene.views
        ],
        points=points,
        colors=scene.colors[chosen].tolist(),
        points_total=len(scene.points),
        unused=[UnusedPhoto(name=name, why=why) for name, why in scene.left_out],
        up=world.up,
    )


def store_placement(placement: Placement, workdir: Path, emit: Callable[[Event], None]) -> None:
    """Write a placement into the folder of the run, and announce it."""
    atomic_write(workdir / PLACEMENT, placement.model_dump_json(exclude_none=True))
    emit(
        CamerasEvent(
            path=PLACEMENT,
            cameras=len(placement.cameras),
            points=placement.points_total,
            final=placement.final,
        )
    )


def _placed_camera(name: str, camera: Camera, split: Any) -> PlacedCamera:
    return PlacedCamera(name=name, split=split, camera=spec_of(camera))


def _chosen(points: np.ndarray[Any, Any]) -> tuple[list[Any], np.ndarray[Any, Any]]:
    """At most MOST_POINTS finite points, to six significant digits, and their indices."""
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    chosen = finite[:: max(1, -(-len(finite) // MOST_POINTS))]
    return [[float(f"{value:.6g}") for value in point] for point in points[chosen]], chosen

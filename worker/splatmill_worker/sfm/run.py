"""The state of one call of `reconstruct`."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import Prepared
from splatmill_worker.sfm import cameras
from splatmill_worker.sfm.callbacks import OnProgress
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.matching.two_view import MIN_INLIERS, TwoView
from splatmill_worker.sfm.options import Effort, SfmOptions
from splatmill_worker.sfm.placed import PlacingObserver, placed
from splatmill_worker.sfm.sift import Features

VERSION = 11
"""Version of everything that is cached; a cache with another version is not read."""

SFM = "sfm"
"""Folder in a work folder of what structure from motion finds."""

UNFOLDED = "unfolded.db"
"""Name of COLMAP's database without the pairs that show things which look alike."""


@dataclass
class EffortResult:
    """What one effort has found so far.

    effort: which effort.
    database: COLMAP's, with cameras, images, features, matches and two-view geometries.
    ids: COLMAP's image id of each photo.
    features: of each photo.
    matched: outcome of each pair that was matched.
    mapped: the models; None before mapping.
    left_out: verified pairs that `mapped` was made without, because they show two things that look alike.
    """

    effort: Effort
    database: Path
    ids: dict[int, int] = field(default_factory=dict)
    features: list[Features] = field(default_factory=list)
    matched: dict[Pair, TwoView] = field(default_factory=dict)
    mapped: mapper.Mapped | None = None
    left_out: frozenset[Pair] = frozenset()

    @property
    def verified(self) -> list[Pair]:
        """The edges of the view graph: pairs with enough inliers."""
        return [pair for pair, outcome in self.matched.items() if outcome.inliers >= MIN_INLIERS]

    @property
    def view_graph(self) -> Path:
        """COLMAP's database that `mapped` was made from: without the pairs `left_out`."""
        return self.database.with_name(UNFOLDED) if self.left_out else self.database


@dataclass
class SfmRun:
    """One call of `reconstruct`: its inputs, and what carries over from one effort to the next.

    prepared: the photos.
    groups: the photos by camera.
    camera_model: COLMAP's name of the lens model that mapping uses.
    options: as they were given.
    folder: where the efforts keep their features and matches.
    threads: number of CPU threads.
    pool: with that many threads.
    on_progress, cancelled: the caller's callbacks.
    observer: called with the mapping while it grows, or None.
    scores: number of preemptive matches of each candidate pair; empty until some effort needs them.
    seconds: time spent so far, by stage.
    notes: sentences for the user.
    best_mapper: the mapper that registered the most photos so far.
    began: when, by the monotonic clock.
    hurried: whether an effort was left out because there was no time for it.
    """

    prepared: Prepared
    groups: list[CameraGroup]
    camera_model: str
    options: SfmOptions
    folder: Path
    threads: int
    pool: ThreadPoolExecutor
    on_progress: OnProgress
    cancelled: Callable[[], bool]
    scores: dict[Pair, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    best_mapper: mapper.Mapper | None = None
    observer: PlacingObserver | None = None
    began: float = field(default_factory=time.monotonic)
    hurried: bool = False

    def has_time_for(self, times: float) -> bool:
        """Whether something that takes `times` the time since the run began would end in the time for the cameras."""
        limit = self.options.seconds
        return limit is None or (1.0 + times) * (time.monotonic() - self.began) <= limit

    @property
    def count(self) -> int:
        """Number of photos."""
        return len(self.prepared.photos)

    def reduced_side(self, effort: Effort) -> int:
        """Longest side of the largest photo on which the effort finds features, in pixels: photos are not enlarged."""
        return min(effort.side, max(max(photo.width, photo.height) for photo in self.prepared.photos))

    def on_mapping(self, done: int, total: int, note: str) -> None:
        """Report the progress of a mapper."""
        self.on_progress("mapping", done, total, note)

    def show(self, model: pycolmap.Reconstruction) -> None:
        """Let the observer look at the model that a mapper works on, where it wants to."""
        if self.observer is not None and self.observer.is_due():
            self.observer.observe(lambda: placed(model, [photo.name for photo in self.prepared.photos]))

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to `seconds[stage]`."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - started


def folder_of(prepared: Prepared, workdir: Path) -> Path:
    """Where what structure from motion finds in these photos is kept."""
    return workdir / SFM / prepared.key[:24]


@contextmanager
def opened(
    prepared: Prepared,
    workdir: Path,
    options: SfmOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Iterator[SfmRun]:
    """A run on these photos, whose threads end with the context."""
    threads = options.threads or os.cpu_count() or 1
    groups = cameras.group(prepared.photos)
    model = options.camera_model if options.camera_model != "auto" else "SIMPLE_RADIAL"
    # Several pairs are matched at the same time, so that each torch call gets one thread.
    with ThreadPoolExecutor(threads) as pool, torch_threads(1):
        folder = folder_of(prepared, workdir)
        yield SfmRun(prepared, groups, model, options, folder, threads, pool, on_progress, cancelled)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let each torch call within the block use `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def digest(*values: object) -> str:
    """A name of 16 hexadecimal digits for the result computed from `values`, by their `repr`."""
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]

"""One call of `reconstruct`: what it was given, what it has found so far, and what that is kept under."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from splatmill_worker.images.prepare import Prepared
from splatmill_worker.sfm import geometry, mapping, pairs
from splatmill_worker.sfm.cameras import Group
from splatmill_worker.sfm.features import Features, Workspace
from splatmill_worker.sfm.options import Effort, SfmOptions

OnProgress = Callable[[str, int, int, str], None]
VERSION = 4  # of what is cached; another one means the cache of an older program is not read


@dataclass
class Progress:
    """What one effort has found so far."""

    effort: Effort
    place: Workspace
    ids: dict[int, int] = field(default_factory=dict)
    features: list[Features] = field(default_factory=list)
    verified: dict[pairs.Pair, geometry.Verified] = field(default_factory=dict)
    mapped: mapping.Mapped | None = None


@dataclass
class Run:
    """One call of `reconstruct`: its inputs, its threads, its clocks, and what carries over between efforts."""

    prepared: Prepared
    groups: list[Group]
    model: str
    options: SfmOptions
    folder: Path
    threads: int
    pool: ThreadPoolExecutor
    on_progress: OnProgress
    cancelled: Callable[[], bool]
    scores: dict[pairs.Pair, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    best_mapper: mapping.Mapper | None = None  # that did best on what was matched so far

    @property
    def count(self) -> int:
        return len(self.prepared.photos)

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - started


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """`count` threads for each torch call."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def digest(*values: object) -> str:
    """A short name for what was computed from `values`."""
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]

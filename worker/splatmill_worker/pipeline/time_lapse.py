"""The time-lapse: snapshots of the scene in training that the model keeps, most often at the beginning."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatmill.files import atomic_write
from splatmill.schema import TIME_LAPSE
from splatmill_worker.pipeline.live import most_covering
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.formats import compressed_ply
from splatmill_worker.splat.report.export import ExportWorld
from splatmill_worker.splat.train.run import TrainingRun

MOST = 24
"""Snapshots of a model."""

MOST_BYTES = 64_000_000
"""Bytes of all snapshots of a model."""

MOST_GAUSSIANS = MOST_BYTES // MOST // 17
"""Gaussians of a snapshot; of a larger scene, it has those that cover the most. One takes 16 bytes and a part of the
ranges that each chunk has."""

SHARE = 0.01
"""Largest share of the training time that snapshots take. Where they would take more, fewer are taken."""

TAKEN_AT = tuple(((i + 0.5) / MOST) ** 2 for i in range(MOST))
"""Shares of the budget at which snapshots are taken: dense at the beginning, where the scene changes most."""


class TimeLapse:
    """Observes a training run and keeps snapshots in `folder`, so that a later attempt continues with them.

    folder: of the snapshots, `000.ply` and so on, each with a `000.json` that says when it was taken.
    world: the coordinates of the snapshots, those of the exported model.
    anew: drop the snapshots of earlier attempts.
    antialiased: whether the scene is trained antialiased.
    clock: seconds; the time between two readings of it is the time of the training.
    seconds: wall time of the snapshots in this attempt.
    """

    def __init__(
        self,
        folder: Path,
        world: ExportWorld,
        *,
        anew: bool,
        antialiased: bool = False,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._folder, self._world, self._clock, self._antialiased = folder, world, clock, antialiased
        if anew:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        self._taken = len(list(folder.glob("*.json")))
        self._next: int | None = None
        self._began, self._from = clock(), 0.0
        self._last = 0.0
        self.seconds = 0.0

    def is_due(self, run: TrainingRun) -> bool:
        """Whether to take a snapshot at this share of the budget. A moment that would cost too much is passed over."""
        progress = run.progress
        if self._next is None:  # the first look of this attempt
            self._began, self._from = self._clock(), progress
            self._next = sum(share < progress for share in TAKEN_AT) if self._taken else 0
        if self._next >= MOST or TAKEN_AT[self._next] > progress or self._taken >= MOST:
            return False
        while self._next < MOST and TAKEN_AT[self._next] <= progress:
            self._next += 1
        return self.seconds + self._last <= self._allowed(progress)

    def _allowed(self, progress: float) -> float:
        """The seconds that the snapshots up to the next moment may take, of the time that the attempt will take."""
        passed = self._clock() - self._began - self.seconds
        whole = passed * (1.0 - self._from) / max(progress - self._from, 1e-6)
        return SHARE * whole * (self._next or 0) / MOST

    def observe(self, run: TrainingRun) -> None:
        """Keep the scene as it is."""
        started, step = self._clock(), run.state.step
        if not self.seconds:
            self._drop_from(step)
        scene = gaussians_of(run.engine)
        shown = self._world.gaussians(most_covering(scene.padded(0), MOST_GAUSSIANS))
        path = self._folder / f"{self._taken:03d}.ply"
        atomic_write(path, compressed_ply.encode(shown, antialiased=self._antialiased))
        facts = {"step": step, "seconds": run.clock.seconds, "gaussians": scene.count, "shown": shown.count}
        # Written after the snapshot, so that one without it is not counted and is written again.
        atomic_write(path.with_suffix(".json"), json.dumps(facts))
        self._taken += 1
        self._last = self._clock() - started
        self.seconds += self._last

    def _drop_from(self, step: int) -> None:
        """Delete snapshots of an earlier attempt that lie after the checkpoint from which this one went on."""
        for facts in sorted(self._folder.glob("*.json")):
            if json.loads(facts.read_text())["step"] >= step:
                facts.unlink()
                facts.with_suffix(".ply").unlink(missing_ok=True)
        self._taken = len(list(self._folder.glob("*.json")))

    def publish(self, out: Path) -> list[dict[str, Any]]:
        """Copy the snapshots into the folder `out` of a model; returns what the report says of each, in order.

        Raises OSError.
        """
        shutil.rmtree(out / TIME_LAPSE, ignore_errors=True)
        rows = []
        for facts in sorted(self._folder.glob("*.json")):
            snapshot = facts.with_suffix(".ply")
            (out / TIME_LAPSE).mkdir(exist_ok=True)
            shutil.copyfile(snapshot, out / TIME_LAPSE / snapshot.name)
            rows.append(
                {
                    "file": f"{TIME_LAPSE}/{snapshot.name}",
                    **json.loads(facts.read_text()),
                    "bytes": snapshot.stat().st_size,
                }
            )
        return rows

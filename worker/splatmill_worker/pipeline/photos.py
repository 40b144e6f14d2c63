"""The second stage: the photos as tensors in the training world."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatmill.schema import ProgressEvent
from splatmill_worker import memory
from splatmill_worker.images.load import load_views, training_size
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.pipeline.events import Emit, progress_events
from splatmill_worker.pipeline.job import Job
from splatmill_worker.scene import View
from splatmill_worker.splat.plan.light import Light
from splatmill_worker.splat.plan.photos import BYTES_PER_PIXEL, fit_in_memory
from splatmill_worker.splat.views import TrainingView


@dataclass(frozen=True)
class Photos:
    """The photos of both parts of the split as tensors, in the training world.

    training, held_out: the photos.
    size: of all of them, with a mask or alpha for each, bytes.
    """

    training: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]
    size: int

    @property
    def on_disk(self) -> bool:
        """Whether they lie in files."""
        return self.training[0].files is not None

    @property
    def shown(self) -> TrainingView:
        """The view of previews and of the progress film: a held-out one where there is any."""
        return (self.held_out or self.training)[0]

    def reporter(self, emit: Emit) -> Callable[[str], None]:
        """A function that reports, by a note, what is done with the photos once all are loaded."""
        count = len(self.training) + len(self.held_out)

        def tell(note: str) -> None:
            emit(ProgressEvent(stage="loading", done=count, total=count, note=note))

        return tell

    def relit(self, light: Light) -> Photos:
        """The photos, with those to train on brought to the light of the photos around them.

        light: of the training photos, in their order, measured at any size of them.

        Held-out photos stay as they are: to fit them to the model would flatter the score.
        """
        changes = zip(self.training, light.departures, strict=True)
        return replace(self, training=tuple(view.relit(departure) for view, departure in changes))


@dataclass(frozen=True)
class Room:
    """Where photos may lie.

    memory: that the run may use for all that it does, bytes.
    folder: for files, of photos that are too large for it.
    """

    memory: int
    folder: Path

    @staticmethod
    def of(job: Job) -> Room:
        """The room of a job: the memory that is free, and no more than its options allow."""
        free = memory.available()
        # For the gpu kernels, the option is about the memory of the card.
        limit = None if job.kernels == "gpu" else job.options.max_memory
        return Room(free if limit is None else min(free, limit), job.workdir)


def load_photos(cameras: Cameras, size: int, room: Room, emit: Emit = lambda event: None) -> Photos:
    """All photos, undistorted, with `size` pixels at most on the longer side; in files where `room` is too small.

    emit: called with the progress of loading, after each photo.

    What this and earlier stages have freed is returned to the system: decoded photos leave pieces in the heap that
    can take as much memory as the photos that are kept.
    """
    pixels = sum(
        math.prod(training_size(view.camera.width, view.camera.height, size))
        for view in (*cameras.training, *cameras.held_out)
    )
    taken = BYTES_PER_PIXEL * pixels
    files = None if fit_in_memory(taken, room.memory) else PixelFiles(room.folder)
    report, total = progress_events(emit), len(cameras.training) + len(cameras.held_out)

    def loaded(views: Sequence[View], before: int) -> tuple[TrainingView, ...]:
        def told(count: int) -> None:
            report("loading", before + count, total, "photos loaded")

        photos = load_views(views, size, files=files, told=told)
        return tuple(TrainingView.of(photo, cameras.normalization, files) for photo in photos)

    training = loaded(cameras.training, 0)
    held_out = loaded(cameras.held_out, len(training))
    memory.return_freed()
    return Photos(training, held_out, taken)

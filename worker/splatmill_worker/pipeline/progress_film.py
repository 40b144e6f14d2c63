"""The progress video: the scene while it is trained, from one view or from an orbit, most often at the beginning."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from splatmill.files import replacing
from splatmill.schema import format_duration
from splatmill_worker.film import Film, with_even_sides
from splatmill_worker.images.guarded import own_picture
from splatmill_worker.splat.orbit import OrbitPath, fit_path
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report.export import ExportWorld
from splatmill_worker.splat.train.renderer import evaluation_background, renderer
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.views import Target, TrainingView

INTERVALS = 96
TAKEN_AT = tuple((i / INTERVALS) ** 2 for i in range(INTERVALS + 1))
"""Shares of the budget at which frames are taken: dense at the beginning, where the scene changes most."""

FPS = 24

HELD = 24
"""Repetitions of the last frame, one second."""

QUALITY = 92
"""JPEG quality of the stored frames."""

CAPTIONED = 160
"""Width in pixels under which the video has no caption, because it would cover too much."""


class ProgressFilm:
    """Observes a training run and keeps each frame as a JPEG in `folder`, so that a later attempt continues with them.

    view: the view that is shown.
    path: from where it is shown instead, once around in the course of the film; None: from where it is.
    anew: drop the frames of earlier attempts.
    seconds: wall time of the frames and the video in this attempt.
    """

    def __init__(
        self, folder: Path, view: TrainingView, plan: Plan, path: OrbitPath | None, *, anew: bool
    ) -> None:
        self._folder, self._view, self._plan, self._path = folder, view, plan, path
        if anew:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        taken = [int(path.stem) for path in folder.glob("*.jpg")]
        self._next = max(taken, default=-1) + 1
        self.seconds = 0.0

    def is_due(self, run: TrainingRun) -> bool:
        """Whether a frame is to be taken at this share of the budget."""
        return self._next < len(TAKEN_AT) and TAKEN_AT[self._next] <= run.progress

    def observe(self, run: TrainingRun) -> None:
        """Take the frame that is due."""
        started = time.perf_counter()
        while self.is_due(run):
            self._next += 1
        number = self._next - 1
        color = renderer(run.engine, self._plan)(
            self._target(number / INTERVALS), evaluation_background(self._plan, [self._view])
        )
        picture = Image.fromarray(
            with_even_sides((color.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
        )
        _caption(picture, f"{format_duration(run.clock.seconds)}   {run.engine.count:,} Gaussians")
        path = self._folder / f"{number:03d}.jpg"
        with replacing(path) as part:
            picture.save(part, "JPEG", quality=QUALITY, subsampling=0)
        self.seconds += time.perf_counter() - started

    def _target(self, share: float) -> Target:
        """What is shown at a share of the film."""
        target = self._view.full
        if self._path is None:
            return target
        viewmat = torch.as_tensor(self._path.viewmat(share), dtype=torch.float32)
        return target._replace(viewmat=viewmat)

    def develop(self, path: Path) -> bool:
        """Write the frames so far as a video, the last one for a second longer; returns False where there are none.

        Raises av.FFmpegError, OSError or ValueError, and leaves no file, where the video cannot be written.
        """
        started = time.perf_counter()
        frames = sorted(self._folder.glob("*.jpg"))
        if not frames:
            return False
        with own_picture(frames[0]) as first:
            width, height = first.size
        with replacing(path) as part, Film(part, width, height, FPS) as film:
            for frame in frames:
                with own_picture(frame) as picture:
                    pixels = np.asarray(picture.convert("RGB"))
                film.add(pixels)
            for _ in range(HELD):
                film.add(pixels)
        self.seconds += time.perf_counter() - started
        return True


def orbit_of(views: Sequence[TrainingView], world: ExportWorld) -> OrbitPath:
    """The path of a film around what the photos of a scene show, in its training world: that of the model's orbit."""
    cameras = [view.full.camera for view in views]
    return fit_path(
        np.array([camera.center for camera in cameras]),
        np.array([camera.axis for camera in cameras]),
        np.array([-camera.viewmat[1, :3] for camera in cameras]),
        **({} if world.up is None else {"up": np.array(world.up), "focus": world.normalization.translation}),
    )


def _caption(picture: Image.Image, text: str) -> None:
    """Write `text` at the lower left, in white with a dark outline, a thirtieth of the picture's width high."""
    if picture.width < CAPTIONED:
        return
    size = max(10, picture.width // 30)
    font = ImageFont.load_default(size)
    ImageDraw.Draw(picture).text(
        (size // 2, picture.height - size // 2),
        text,
        fill=(255, 255, 255),
        font=font,
        anchor="lb",
        stroke_width=max(1, size // 10),
        stroke_fill=(20, 20, 20),
    )

"""A video of a scene as it is trained: one view, from a fixed camera, at moments that lie close where much changes."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from splatmill.files import replacing
from splatmill.schema import format_duration
from splatmill_worker.film import Film, with_even_sides
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.renderer import render_view
from splatmill_worker.splat.views import TrainingView

SHOTS = 96
MOMENTS = tuple((i / SHOTS) ** 2 for i in range(SHOTS + 1))
"""Shares of the budget: the first second changes more than the last minute."""

FPS, HELD = 24, 24
QUALITY = 92
CAPTIONED = 160  # pixels of width under which a line of text covers too much of the picture


class ProgressFilm:
    """Shots kept in `folder` as they are taken, so that a later attempt goes on with the film of this one.

    A shot is one forward pass and one JPEG, taken while the training clock stands still. `seconds` is what shots and
    video cost this attempt; what earlier ones spent is in no account.
    """

    def __init__(self, folder: Path, view: TrainingView, plan: Plan, *, anew: bool) -> None:
        self._folder, self._view, self._plan = folder, view, plan
        if anew:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        taken = [int(path.stem) for path in folder.glob("*.jpg")]
        self._next = max(taken, default=-1) + 1
        self.seconds = 0.0

    def is_due(self, progress: float) -> bool:
        """Whether a shot is to be taken at this share of the budget."""
        return self._next < len(MOMENTS) and MOMENTS[self._next] <= progress

    def observe(self, engine: Engine, progress: float, seconds: float) -> None:
        """Take the shot that is due, `seconds` into the training."""
        started = time.perf_counter()
        color = render_view(engine, self._plan, self._view)
        picture = Image.fromarray(
            with_even_sides((color.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
        )
        _caption(picture, f"{format_duration(seconds)}   {engine.count:,} Gaussians")
        while self.is_due(progress):
            self._next += 1
        path = self._folder / f"{self._next - 1:03d}.jpg"
        with replacing(path) as part:
            picture.save(part, "JPEG", quality=QUALITY, subsampling=0)
        self.seconds += time.perf_counter() - started

    def develop(self, path: Path) -> bool:
        """Write the shots so far as a video, the last one held for a second; False, and no file, without shots.

        Raises av.FFmpegError, OSError or ValueError, and leaves no file, where the video cannot be written.
        """
        started = time.perf_counter()
        shots = sorted(self._folder.glob("*.jpg"))
        if not shots:
            return False
        with Image.open(shots[0]) as first:
            width, height = first.size
        with replacing(path) as part, Film(part, width, height, FPS) as film:
            for shot in shots:
                with Image.open(shot) as picture:
                    pixels = np.asarray(picture.convert("RGB"))
                film.add(pixels)
            for _ in range(HELD):
                film.add(pixels)
        self.seconds += time.perf_counter() - started
        return True


def _caption(picture: Image.Image, text: str) -> None:
    """White letters with a dark rim at the lower left, a thirtieth of the picture's width high."""
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

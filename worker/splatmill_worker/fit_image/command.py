"""`splatmill fit-image`: fits one picture by Gaussians in a plane."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import av

from splatmill.schema import FitImageOptions
from splatmill_worker.errors import Refusal, TrainingFailed
from splatmill_worker.fit_image import plane
from splatmill_worker.fit_image.gabor import FittedWaves, gaussians_for
from splatmill_worker.fit_image.photo import Say, load
from splatmill_worker.fit_image.results import Result, write_results
from splatmill_worker.fit_image.video import TAKEN_AT, FitVideo
from splatmill_worker.splat.plan.budget import Budget

PIXELS_PER_GAUSSIAN = 16
"""Pixels for each Gaussian, where the options give no number."""

DEFAULT_SECONDS = 60.0
"""Time budget, where the options give neither a time nor steps."""

REFUSED, FAILED, UNWRITABLE, STOPPED = 5, 3, 1, 130
"""Exit statuses, those of the command line: the picture cannot be used; the optimisation failed; the results could
not be written; Ctrl-C."""

FAILED_ADVICE = "Try another seed, or fewer Gaussians."
"""Advice for a numerical failure; that of TrainingFailed is about the photos and cameras of a scene."""


class InterruptedWhileWriting(KeyboardInterrupt):
    """Ctrl-C while the results were being written: some are missing, or left from an earlier fit."""


def main(photo: Path, out: Path, options: str) -> int:
    """Run from the command line, with FitImageOptions as JSON; returns the exit status."""
    settings = FitImageOptions.model_validate_json(options)
    try:
        result = fit_image(photo, out, settings, lambda line: print(line, flush=True))
    except Refusal as refusal:
        print(f"Error: {refusal.message}\n{refusal.advice}", file=sys.stderr)
        return REFUSED
    except TrainingFailed as failure:
        print(
            f"Error: Fitting stopped at step {failure.step}: {failure.symptom} {FAILED_ADVICE}",
            file=sys.stderr,
        )
        return FAILED
    except (OSError, av.FFmpegError) as error:
        print(f"Error: {error.filename or out}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except InterruptedWhileWriting:
        print(f"Stopped while the results were being written; {out} is incomplete.", file=sys.stderr)
        return STOPPED
    except KeyboardInterrupt:
        print("Stopped; nothing was written.", file=sys.stderr)
        return STOPPED
    score = result.score
    print(f"{result.gaussians:,} Gaussians, PSNR {score.psnr:.2f} dB, SSIM {score.ssim:.4f}")
    for path in result.files:
        print(f"  {path}")
    return 0


def fit_image(photo: Path, out: Path, options: FitImageOptions, say: Say = lambda _: None) -> Result:
    """Fit `photo`, and write model.ply, cameras.json, picture.png, fit.json, fit.png (and fit.mp4) into `out`.

    With `options.gabor`, model.npz takes the place of model.ply and cameras.json, and there are fewer Gaussians, so
    that they have as many parameters in all.

    The score of the result is that of the stored model. Raises Refusal for an unusable picture, TrainingFailed for a
    numerical failure, OSError or av.FFmpegError where `out` cannot be written, and InterruptedWhileWriting for Ctrl-C
    while it is.
    """
    view = load(photo, options.image_size, say)
    camera = view.full.camera
    limit = _gaussians(camera.width * camera.height, options, say)
    gabor = FittedWaves() if options.gabor else None
    if gabor is not None:
        limit = gaussians_for(limit)
    seconds = options.time_budget
    if seconds is None and options.steps is None:
        seconds = DEFAULT_SECONDS
    say(f"{photo.name}: {camera.width} x {camera.height} pixels, at most {limit:,} Gaussians")
    out.mkdir(parents=True, exist_ok=True)

    def evaluated(point: plane.FitPoint) -> None:
        say(
            f"{point.seconds:7.1f} s  {point.step:6d} steps  {point.gaussians:8,} Gaussians  "
            f"PSNR {point.score.psnr:.2f} dB  SSIM {point.score.ssim:.4f}"
        )

    writing = False
    try:
        with ExitStack() as stack:
            video = stack.enter_context(FitVideo.writing(out / "fit.mp4", view)) if options.video else None
            fitted, curve = plane.fit(
                view,
                limit,
                Budget(options.steps, seconds),
                seed=options.seed,
                gabor=gabor,
                evaluated=evaluated,
                frames_at=() if video is None else TAKEN_AT,
                frame=lambda color: None if video is None else video.add(color),
            )
            if video is not None:
                video.hold()
            writing = True
            waves = None if gabor is None else gabor.waves
            return write_results(out, options, view, fitted, curve, waves)
    except KeyboardInterrupt as stop:
        if writing:
            raise InterruptedWhileWriting from stop
        raise


def _gaussians(pixels: int, options: FitImageOptions, say: Say) -> int:
    """The largest number of Gaussians for a picture of so many pixels."""
    asked = options.gaussians or min(pixels, max(64, pixels // PIXELS_PER_GAUSSIAN))
    if asked > pixels:
        say(f"{asked} Gaussians were asked for; the picture has {pixels} pixels, so {pixels} are used.")
    return min(asked, pixels)

"""One picture in, a flat scene of Gaussians out: `splatmill fit-image`."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from splatmill.files import replacing
from splatmill.schema import FitImageOptions, ModelCamera, ModelCameras
from splatmill.schema.photos import MAX_PHOTO_PIXELS, MIN_PHOTO_SIDE
from splatmill_worker.errors import Refusal, TrainingFailed
from splatmill_worker.film import Film, with_even_sides
from splatmill_worker.fit_image import plane
from splatmill_worker.images import load_view
from splatmill_worker.images.decode import upright_size
from splatmill_worker.scene import Normalization, View
from splatmill_worker.splat import ply
from splatmill_worker.splat.evaluate import ViewScore, compare
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.machine import machine, peak_memory, versions
from splatmill_worker.splat.picture import as_image
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.render import render
from splatmill_worker.splat.report.export import spec_of
from splatmill_worker.splat.report.figure import draw_curve
from splatmill_worker.splat.report.report import plain
from splatmill_worker.splat.views import TrainingView

PIXELS_PER_GAUSSIAN = 16
DEFAULT_SECONDS = 60.0
FRAMES, FPS, LAST_FRAMES = 120, 24, 24
DEGREE = 3
"""Coefficients above degree 0 are zero and still written: the first viewers read files with all of them only."""

REFUSED, FAILED, UNWRITABLE, STOPPED = 5, 3, 1, 130
"""Exit statuses, those of the command line: the picture cannot be used; the optimisation failed; the results could
not be written; Ctrl-C."""

FAILED_ADVICE = "Try another seed, or fewer Gaussians."
"""For a numerical failure; what `failure` advises is about the photos and cameras of a scene."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Result:
    """What the written file shows, and the files."""

    gaussians: int
    score: ViewScore
    files: tuple[Path, ...]


class NotWhole(KeyboardInterrupt):
    """Ctrl-C while the results were being written: those in the folder are not whole, or not of one fit."""


def main(photo: Path, out: Path, options: str) -> int:
    """Run from the command line; returns the exit status."""
    wanted = FitImageOptions.model_validate_json(options)
    try:
        result = fit_image(photo, out, wanted, lambda line: print(line, flush=True))
    except Refusal as refusal:
        print(f"Error: {refusal.message}\n{refusal.advice}", file=sys.stderr)
        return REFUSED
    except TrainingFailed as failure:
        print(
            f"Error: Fitting stopped at step {failure.step}: {failure.seen} {FAILED_ADVICE}", file=sys.stderr
        )
        return FAILED
    except (OSError, av.FFmpegError) as error:
        print(f"Error: {error.filename or out}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except NotWhole:
        print(f"Stopped before the end; what is in {out} is not whole.", file=sys.stderr)
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
    """Fit `photo` and leave model.ply, picture.png, cameras.json, fit.json, fit.png (and fit.mp4) in `out`.

    The result is judged by what the written file shows. Raises Refusal for what is no usable picture,
    TrainingFailed for a numerical failure, OSError or av.FFmpegError where `out` cannot be written, and NotWhole where
    Ctrl-C comes while it is.
    """
    view = load(photo, options.image_size, say)
    camera = view.full.camera
    pixels = camera.width * camera.height
    most = options.gaussians or min(pixels, max(64, pixels // PIXELS_PER_GAUSSIAN))
    if most > pixels:
        say(
            f"{most} Gaussians were asked for; the picture has {pixels} pixels, and more would describe nothing."
        )
        most = pixels
    seconds = options.time_budget
    if seconds is None and options.steps is None:
        seconds = DEFAULT_SECONDS
    say(f"{photo.name}: {camera.width} x {camera.height} pixels, at most {most:,} Gaussians")
    out.mkdir(parents=True, exist_ok=True)

    def tell(row: plane.Row) -> None:
        say(
            f"{row.seconds:7.1f} s  {row.step:6d} steps  {row.gaussians:8,} Gaussians  "
            f"PSNR {row.score.psnr:.2f} dB  SSIM {row.score.ssim:.4f}"
        )

    writing = False
    try:
        with ExitStack() as stack:
            film = stack.enter_context(_emerging(out / "fit.mp4", view)) if options.video else None
            fitted, rows = plane.fit(
                view,
                most,
                Budget(options.steps, seconds),
                seed=options.seed,
                measured=tell,
                moments=() if film is None else tuple((i / FRAMES) ** 2 for i in range(FRAMES)),
                frame=lambda color, _: None if film is None else film.add(color),
            )
            if film is not None:
                film.hold()
            writing = True
            result = _written(photo, out, options, view, fitted, rows)
    except KeyboardInterrupt as stop:
        if writing:
            raise NotWhole from stop
        raise
    return result


def _written(
    photo: Path,
    out: Path,
    options: FitImageOptions,
    view: TrainingView,
    fitted: Gaussians,
    rows: list[plane.Row],
) -> Result:
    """All results but the video."""
    camera, transparent = view.full.camera, view.full.alpha is not None
    files = [out / name for name in ("model.ply", "picture.png", "cameras.json", "fit.json", "fit.png")]
    comments = (
        "Made by Splatmill",
        f"one picture, seen from the origin along z, {_angle(camera.width, camera.fx)}",
    )
    ply.write(files[0], fitted, degree=DEGREE, comments=comments)
    stored = ply.read(files[0])
    shown = render(stored, camera, background=torch.ones(3))
    score = compare(view.name, shown.color, view.full.over(torch.ones(3)))
    _picture(shown.color, shown.alpha, transparent).save(files[1])
    cameras = ModelCameras(cameras=[ModelCamera(name=view.name, camera=spec_of(camera), psnr=score.psnr)])
    files[2].write_text(cameras.model_dump_json(exclude_none=True, indent=1))
    curve = [_point(row) for row in rows]
    files[3].write_text(json.dumps(plain(_report(photo, options, stored.count, score, curve)), indent=1))
    draw_curve(files[4], curve, {"fit": rows[-1].seconds}, measured="the picture")
    return Result(stored.count, score, (*files, out / "fit.mp4") if options.video else tuple(files))


def load(photo: Path, longest_side: int, say: Say = lambda _: None) -> TrainingView:
    """The picture, upright, in 8 bits, at most `longest_side` pixels long. Raises Refusal with what was seen."""
    try:
        width, height = _size(photo, say)
        if max(width, height) > longest_side:
            say(f"The picture is {width} x {height} pixels; it is scaled down to {longest_side}.")
        view = load_view(View(photo.name, plane.camera_before(width, height), photo), longest_side)
    except UnidentifiedImageError as error:
        raise Refusal(
            "not_an_image",
            f"{photo} is not a picture that can be read.",
            advice="Give a JPEG, PNG, WebP, TIFF or HEIC file.",
        ) from error
    except (OSError, ValueError, SyntaxError, EOFError, IndexError) as error:
        if isinstance(error, FileNotFoundError | IsADirectoryError | PermissionError):
            raise Refusal(
                "not_an_image", f"{photo} cannot be read: {error.strerror}.", advice="Give one picture file."
            ) from error
        raise Refusal(
            "image_truncated",
            f"{photo} does not decode to its end: {error}.",
            advice="Save the picture again from the program it came from.",
        ) from error
    if view.alpha is not None and not view.alpha.any():
        raise Refusal(
            "not_an_image",
            f"{photo} is transparent everywhere.",
            advice="Give a picture that shows something.",
        )
    return TrainingView.of(view, Normalization(1.0, np.zeros(3)))


def _size(photo: Path, say: Say) -> tuple[int, int]:
    """Upright width and height from the header. Raises Refusal for a size that cannot be fitted."""
    with Image.open(photo) as image:
        width, height = upright_size(image)
        pictures = getattr(image, "n_frames", 1)
    if min(width, height) < MIN_PHOTO_SIDE:
        raise Refusal(
            "image_too_small",
            f"{photo} is {width} x {height} pixels; sides of {MIN_PHOTO_SIDE} pixels at least are fitted.",
            advice="Give a larger picture, or enlarge this one.",
        )
    if width * height > MAX_PHOTO_PIXELS:
        raise Refusal(
            "image_too_large",
            f"{photo} is {width} x {height} pixels; at most {MAX_PHOTO_PIXELS // 10**6} million are decoded.",
            advice="Scale the picture down first.",
        )
    if pictures > 1:
        say(f"{photo.name} holds {pictures} pictures; the first one is fitted.")
    return width, height


@contextmanager
def _emerging(path: Path, view: TrainingView) -> Iterator[_Emerging]:
    """The video at `path`, which is there when it is whole."""
    height, width = with_even_sides(view.full.rgb.numpy()).shape[:2]
    with replacing(path) as part, Film(part, width, height, FPS) as film:
        yield _Emerging(film, width, height)


class _Emerging:
    """The video of the picture as it emerges, over white."""

    def __init__(self, film: Film, width: int, height: int) -> None:
        self._film = film
        self._last = np.full((height, width, 3), 255, np.uint8)

    def add(self, color: Tensor) -> None:
        """Append a rendering [H, W, 3]."""
        self._last = with_even_sides(np.asarray(as_image(color)))
        self._film.add(self._last)

    def hold(self) -> None:
        """Let the end be seen for a second."""
        for _ in range(LAST_FRAMES):
            self._film.add(self._last)


def _picture(color: Tensor, alpha: Tensor, transparent: bool) -> Image.Image:
    """The rendering over white as a picture, with its alpha where the photo had one."""
    if not transparent:
        return as_image(color)
    cover = alpha.clamp(0.0, 1.0)[..., None]
    own = ((color - (1.0 - cover)) / cover.clamp_min(1e-6)).clamp(0.0, 1.0)
    return as_image(torch.cat([own, cover], dim=2))


def _point(row: plane.Row) -> dict[str, Any]:
    return {
        "seconds": row.seconds,
        "step": row.step,
        "gaussians": row.gaussians,
        "psnr": row.score.psnr,
        "ssim": row.score.ssim,
    }


def _report(
    photo: Path, options: FitImageOptions, gaussians: int, score: ViewScore, curve: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "photo": photo.name,
        "options": options.model_dump(mode="json"),
        "curve": curve,
        "result": {"gaussians": gaussians, "psnr": score.psnr, "ssim": score.ssim, "mse": score.mse},
        "peak_memory": peak_memory(),
        "versions": versions("cpu"),
        "machine": machine(),
    }


def _angle(width: int, focal: float) -> str:
    return f"{math.degrees(2 * math.atan(width / (2 * focal))):.3f} degrees wide"

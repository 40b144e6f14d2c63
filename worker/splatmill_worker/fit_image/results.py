"""The files that a fit leaves, all but the video."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from splatmill.files import atomic_write, replacing
from splatmill.schema import FitImageOptions, ModelCamera, ModelCameras
from splatmill_worker.fit_image import wave_file
from splatmill_worker.fit_image.plane import FitPoint
from splatmill_worker.kernels.records import Waves
from splatmill_worker.scene import Camera
from splatmill_worker.splat.evaluate import ViewScore, compare
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.machine import machine, peak_memory, versions
from splatmill_worker.splat.picture import as_image
from splatmill_worker.splat.render import render
from splatmill_worker.splat.report.export import spec_of
from splatmill_worker.splat.report.figure import draw_curve
from splatmill_worker.splat.report.report import plain
from splatmill_worker.splat.views import TrainingView

DEGREE = 3
"""SH degree of the file. The coefficients above degree 0 are zero; some viewers read only files that have them."""


@dataclass(frozen=True)
class Result:
    """What a fit left.

    gaussians: how many the model holds.
    score: error of the stored model, rendered, against the picture.
    files: all files, the video among them where one was asked for.
    """

    gaussians: int
    score: ViewScore
    files: tuple[Path, ...]


def write_results(
    out: Path,
    options: FitImageOptions,
    view: TrainingView,
    fitted: Gaussians,
    curve: Sequence[FitPoint],
    waves: Waves | None = None,
) -> Result:
    """Write model.ply, cameras.json, picture.png, fit.json and fit.png into `out`; adds fit.mp4 to the list where
    `options` ask for it. With `waves`, one model.npz takes the place of the first two.

    Raises OSError where a file cannot be written.
    """
    camera = view.full.camera
    picture, report, figure = (out / name for name in ("picture.png", "fit.json", "fit.png"))
    white = torch.ones(3)
    if waves is None:
        models = [out / "model.ply", out / "cameras.json"]
        stored = _write_splats(models[0], fitted, camera)
        shown = render(stored, camera, background=white)
        color, alpha = shown.color, shown.alpha
    else:
        models = [out / "model.npz"]
        wave_file.write(models[0], fitted, waves, camera)
        stored, kept = wave_file.read(models[0])
        color, alpha = wave_file.rendered(stored, kept, camera, white)
    score = compare(view.name, color, view.full.over(white))
    if waves is None:
        cameras = ModelCameras(cameras=[ModelCamera(name=view.name, camera=spec_of(camera), psnr=score.psnr)])
        atomic_write(models[1], cameras.model_dump_json(exclude_none=True, indent=1))
    with replacing(picture) as part:
        _picture(color, alpha, view.full.alpha is not None).save(part, "PNG")
    points = [_point(point) for point in curve]
    numbers = {"gaussians": stored.count} | ({} if waves is None else {"waves": len(waves.values)})
    atomic_write(report, json.dumps(plain(_report(view.name, options, numbers, score, points)), indent=1))
    draw_curve(figure, points, {"fit": curve[-1].seconds}, evaluated="the picture")
    video = [out / "fit.mp4"] if options.video else []
    return Result(stored.count, score, (*models, picture, report, figure, *video))


def _write_splats(path: Path, fitted: Gaussians, camera: Camera) -> Gaussians:
    """Write model.ply, and return what it holds."""
    comments = (
        "Made by Splatmill",
        f"one picture, seen from the origin along z, {_angle(camera.width, camera.fx)}",
    )
    ply.write(path, fitted, degree=DEGREE, comments=comments)
    return ply.read(path).gaussians


def _picture(color: Tensor, alpha: Tensor, transparent: bool) -> Image.Image:
    """The rendering over white as a picture, with its alpha where `transparent`."""
    if not transparent:
        return as_image(color)
    cover = alpha.clamp(0.0, 1.0)[..., None]
    own = ((color - (1.0 - cover)) / cover.clamp_min(1e-6)).clamp(0.0, 1.0)
    return as_image(torch.cat([own, cover], dim=2))


def _point(point: FitPoint) -> dict[str, Any]:
    return {
        "seconds": point.seconds,
        "step": point.step,
        "gaussians": point.gaussians,
        "psnr": point.score.psnr,
        "ssim": point.score.ssim,
    }


def _report(
    name: str,
    options: FitImageOptions,
    numbers: dict[str, int],
    score: ViewScore,
    curve: list[dict[str, Any]],
) -> dict[str, Any]:
    """What fit.json holds."""
    return {
        "photo": name,
        "options": options.model_dump(mode="json"),
        "curve": curve,
        "result": {**numbers, "psnr": score.psnr, "ssim": score.ssim, "mse": score.mse},
        "peak_memory": peak_memory(),
        "versions": versions("cpu"),
        "machine": machine(),
    }


def _angle(width: int, focal: float) -> str:
    return f"{math.degrees(2 * math.atan(width / (2 * focal))):.3f} degrees wide"

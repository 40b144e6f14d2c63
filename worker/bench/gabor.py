"""A wave for half of the Gaussians of a picture (`fit-image --gabor`) against plain ones, with as many parameters.

    splatmill bench gabor                                  # ten pictures, two sizes of model: about ten minutes
    splatmill bench gabor --pictures weave --side 64 --steps 100 --dry
    splatmill bench gabor --pictures --photos photos/a.jpg photos/b.jpg

Every picture is fitted by plain Gaussians and by ones of which half have a wave (9 parameters a Gaussian, 6 a wave) in
as many steps, and once more by plain ones in the CPU seconds that the waves took. Of a photo, the square in its middle
is reduced to the size of the pictures; photos are no part of the figure. Seconds are CPU seconds of one thread, with
the thirteen evaluations of a fit.

Expected before it was measured: several dB where one frequency repeats (stripes, knit, weave), nothing on smooth
colours, and a loss of some tenths on text, whose edges need places rather than frequencies; twice the time of a step.
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import _page
import _plot
import numpy as np
import torch
from _gabor.pictures import PICTURES, picture
from _rows import Row, distinct, footer, of
from _studies.study import Study
from matplotlib.figure import Figure
from PIL import Image

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.fit_image import plane
from splatmill_worker.fit_image.gabor import PLAIN_PARAMETERS, WAVE_PARAMETERS, FittedWaves, gaussians_for
from splatmill_worker.fit_image.photo import load
from splatmill_worker.images import guarded
from splatmill_worker.splat.plan.budget import Budget

PAYS = 0.2
"""dB from which a gain or a loss is named."""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of the pictures, and of the photos that were asked for."""
    torch.set_num_threads(1)
    for name in options.pictures:
        if name not in PICTURES:
            yield f"{name} is none of the pictures: {', '.join(PICTURES)}."
            continue
        yield from compared(name, picture(name, options.side), options)
    for path in options.photos:
        try:
            with guarded.opened(path) as photo:
                side = min(photo.size)
                left, top = (photo.width - side) // 2, (photo.height - side) // 2
                square = photo.convert("RGB").crop((left, top, left + side, top + side))
                pixels = np.asarray(square.resize((options.side, options.side), Image.Resampling.LANCZOS))
        except (OSError, UnusablePicture) as error:
            yield f"{path} is left out: {error}."
            continue
        yield from compared(f"photo {path.stem}", pixels, options)


def compared(name: str, pixels: np.ndarray, options: argparse.Namespace) -> Iterator[Row]:
    """Plain and Gabor in equal steps, and plain in Gabor's time, at every size of model."""
    for share in options.pixels:
        limit = pixels.shape[0] * pixels.shape[1] // share
        row = {"bench": "gabor", "picture": name, "side": pixels.shape[0], "pixels_per_gaussian": share}
        plain = fitted(pixels, limit, options.steps, options.seed, gabor=False)
        yield row | {"method": "plain"} | plain
        gabor = fitted(pixels, limit, options.steps, options.seed, gabor=True)
        yield row | {"method": "gabor"} | gabor
        steps = round(options.steps * gabor["seconds"] / plain["seconds"])
        yield row | {"method": "plain, equal time"} | fitted(pixels, limit, steps, options.seed, gabor=False)


def fitted(pixels: np.ndarray, limit: int, steps: int, seed: int, *, gabor: bool) -> Row:
    """The fields of one fit with the parameters of `limit` plain Gaussians."""
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        path = Path(folder) / "picture.png"
        Image.fromarray(pixels).save(path)
        view = load(path, 8192)
    waves = FittedWaves() if gabor else None
    began = time.process_time()
    watch: list[tuple[float, float]] = []

    def evaluated(point: plane.FitPoint) -> None:
        watch.append((time.process_time() - began, point.score.psnr))

    gaussians, curve = plane.fit(
        view,
        gaussians_for(limit) if gabor else limit,
        Budget(steps, None),
        seed=seed,
        gabor=waves,
        evaluated=evaluated,
    )
    count = 0 if waves is None else len(waves.waves.values)
    score = curve[-1].score
    return {
        "steps": steps,
        "seed": seed,
        "gaussians": gaussians.count,
        "waves": count,
        "parameters": PLAIN_PARAMETERS * gaussians.count + WAVE_PARAMETERS * count,
        "psnr": round(score.psnr, 3),
        "ssim": round(score.ssim, 4),
        "seconds": round(watch[-1][0], 2),
        "curve": [[round(seconds, 2), round(psnr, 2)] for seconds, psnr in watch],
    }


def pairs(rows: list[Row]) -> Iterator[tuple[Row, Row, Row]]:
    """Plain, Gabor and plain in Gabor's time of each picture and size of model."""
    for name in distinct(rows, "picture"):
        for share in sorted(set(distinct(rows, "pixels_per_gaussian"))):
            by_method = [
                of(rows, picture=name, pixels_per_gaussian=share, method=method)
                for method in ("plain", "gabor", "plain, equal time")
            ]
            if all(by_method):
                yield by_method[0][0], by_method[1][0], by_method[2][0]


def table(rows: list[Row]) -> str:
    head = "picture|pixels per Gaussian:|plain:|with waves:|gain:|gain in equal time:|SSIM plain:|with waves:"
    head += "|CPU seconds plain:|with waves:"
    lines = [
        [
            plain["picture"], plain["pixels_per_gaussian"], f"{plain['psnr']:.2f} dB", f"{gabor['psnr']:.2f} dB",
            f"{gabor['psnr'] - plain['psnr']:+.2f} dB", f"{gabor['psnr'] - longer['psnr']:+.2f} dB",
            f"{plain['ssim']:.4f}", f"{gabor['ssim']:.4f}", f"{plain['seconds']:.1f}", f"{gabor['seconds']:.1f}",
        ]
        for plain, gabor, longer in pairs(rows)
    ]  # fmt: skip
    return _page.table(head, lines)


def conclusion(rows: list[Row]) -> str:
    """When waves pay, by what the rows say."""
    said = []
    for share in sorted(set(distinct(rows, "pixels_per_gaussian"))):
        here = [(p, g, t) for p, g, t in pairs(rows) if p["pixels_per_gaussian"] == share]
        if not here:
            continue
        gains = {p["picture"]: g["psnr"] - t["psnr"] for p, g, t in here}
        better = [f"{name} ({gain:+.1f} dB)" for name, gain in gains.items() if gain >= PAYS]
        worse = [f"{name} ({gain:+.1f} dB)" for name, gain in gains.items() if gain <= -PAYS]
        slower = statistics.median(
            g["seconds"] / g["steps"] / (p["seconds"] / p["steps"]) for p, g, _ in here
        )
        said.append(
            f"- One Gaussian for every {share} pixels, in equal time: waves pay on {', '.join(better) or 'nothing'}; "
            f"they lose on {', '.join(worse) or 'nothing'}. A step takes {slower:.2f} times as long."
        )
    return "\n".join(said)


def draw(rows: list[Row]) -> Figure:
    """For every picture, the root mean square error against CPU seconds, at the largest model."""
    share = min(distinct(rows, "pixels_per_gaussian"), default=0)
    names = [name for name in PICTURES if of(rows, picture=name)]
    columns = max(1, min(5, len(names)))
    lines = max(1, math.ceil(len(names) / columns))
    figure, panels = _plot.axes(columns, lines, width=3.0, height=2.6 * lines)
    looks = {
        "plain": ("-", _plot.CYCLE[0]),
        "gabor": ("-", _plot.CYCLE[1]),
        "plain, equal time": ("--", _plot.CYCLE[0]),
    }
    for panel, name in zip(panels, names, strict=False):
        for method, (style, color) in looks.items():
            for row in of(rows, picture=name, pixels_per_gaussian=share, method=method):
                seconds, psnr = zip(*row["curve"], strict=True)
                panel.plot(seconds, [10 ** (-x / 20) for x in psnr], style, color=color, label=method, lw=1.3)
        _plot.name(panel, title=name, log="xy", size=8)
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    _plot.name(panels[0], y="RMS error of colours", size=8)
    _plot.name(panels[columns * (lines - 1)], "CPU seconds", size=8)
    if names:
        panels[0].legend(fontsize=6)
    return figure


def made(rows: list[Row]) -> str:
    steps = ", ".join(str(x) for x in distinct(of(rows, method="plain"), "steps"))
    side = ", ".join(str(x) for x in distinct(rows, "side"))
    return f"Made by `splatmill bench gabor` with {steps} steps at {side} pixels.\n{footer(rows)}"


STUDY = Study(
    name="gabor",
    about=__doc__,
    cases={"pictures": measured},
    key=("picture", "pixels_per_gaussian", "method", "seed"),
    blocks={"conclusion": conclusion, "table": table, "footer": made},
    figures={"gabor": draw},
    options={
        "pictures": {"nargs": "*", "default": list(PICTURES)},
        "photos": {"nargs": "*", "type": Path, "default": []},
        "pixels": {"nargs": "+", "type": int, "default": [16, 64], "help": "pixels for each plain Gaussian"},
        "side": {"type": int, "default": 96},
        "steps": {"type": int, "default": 800},
        "seed": {"type": int, "default": 0},
    },
)
main = STUDY.main

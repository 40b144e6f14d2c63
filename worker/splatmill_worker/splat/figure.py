"""Error against run time as a picture, with what it took: Gaussians and memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # a worker has no display
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

QUANTISATION_PSNR = 58.9
"""dB between a photo and its own 8-bit copy: nothing can be measured to be better."""

ERROR, GAUSSIANS, MEMORY = "#1f6f8b", "#c97b3d", "#7a5c99"


def draw_curve(
    path: Path,
    curve: Sequence[dict[str, Any]],
    seconds: dict[str, float],
    *,
    measured: str = "held-out PSNR (dB)",
) -> None:
    """PSNR (of what `measured` says) against training seconds; below it the Gaussians and, where known, the memory.

    Without any PSNR in the curve, the training loss is drawn.
    """
    figure = Figure(figsize=(7.2, 5.4), dpi=130, layout="constrained")
    error, cost = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.4))
    times = [row["seconds"] for row in curve]
    judged = [row for row in curve if row["psnr"] is not None]
    if judged:
        _line(error, [row["seconds"] for row in judged], [row["psnr"] for row in judged])
        error.set_ylabel(measured)
        last = judged[-1]
        # In the corner that a rising curve leaves free.
        error.text(
            0.985,
            0.06,
            f"{last['psnr']:.2f} dB, SSIM {last['ssim']:.3f}",
            transform=error.transAxes,
            ha="right",
            fontsize=10,
        )
    else:
        _line(error, times, [row["loss"] for row in curve])
        error.set_ylabel("training loss (no photo was held out)")
    _line(cost, times, [row["gaussians"] / 1000.0 for row in curve], GAUSSIANS)
    cost.set_ylabel("thousand\nGaussians", color=GAUSSIANS)
    cost.set_ylim(0, 1.1 * max((row["gaussians"] / 1000.0 for row in curve), default=1.0) or 1.0)
    held = [(row["seconds"], row["memory"] / 1e9) for row in curve if row.get("memory")]
    if held:
        memory = cost.twinx()
        _line(memory, [moment for moment, _ in held], [size for _, size in held], MEMORY)
        memory.set_ylabel("memory (GB)", color=MEMORY)
        memory.set_ylim(0, 1.25 * max(size for _, size in held))  # apart from the Gaussians' line
        memory.spines["top"].set_visible(False)
    if times and min(times) > 0:
        _logarithmic(cost)
    cost.set_xlabel("training seconds")
    for axes in (error, cost):
        axes.grid(True, which="major", color="#dddddd", linewidth=0.5)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    apart = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items() if value >= 0.05)
    error.set_title(apart, fontsize=8, loc="left", color="#555555")
    figure.savefig(path)


def _line(axes: Axes, x: Sequence[float], y: Sequence[float], color: str = ERROR) -> None:
    axes.plot(x, y, "o-", color=color, ms=4 if color == ERROR else 2.5, linewidth=1.6)


def _logarithmic(axes: Axes) -> None:
    """Seconds at 1, 2 and 5 of every decade, as plain numbers."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())

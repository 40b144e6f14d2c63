"""The figure of error against run time, with the number of Gaussians and the memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from splatmill.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ERROR, TRAINING, VALIDATION, GAUSSIANS, MEMORY = "#1f6f8b", "#9aa5ad", "#8ab87c", "#c97b3d", "#7a5c99"
"""Colours of the lines."""

LEAST_DISSIMILARITY = 1e-4
"""1 - SSIM of photos that are shown exactly, for the logarithmic axis."""

BEFORE_TRAINING = ("sfm", "load", "plan")
"""Stages of a job that end before its training begins."""

_MARGINS = {"left": 0.13, "right": 0.9, "top": 0.96, "bottom": 0.11, "hspace": 0.08}
"""Room for the labels, in shares of the figure. matplotlib would find it by drawing everything twice."""


def draw_curve(
    path: Path,
    curve: Sequence[dict[str, Any]],
    seconds: dict[str, float],
    *,
    evaluated: str = "held-out photos",
) -> None:
    """Draw the error, the number of Gaussians and, where known, the memory against training seconds.

    The error is shown as PSNR with the root mean square beside it, and as 1 - SSIM on a logarithmic axis.

    path: the PNG file to write.
    curve: points as in report.json. Where they have train_psnr and train_ssim, training photos get a line of their
        own, and over-fitting shows as a rise of that line alone. So do validation photos, by validation_psnr.
    seconds: by stage, for the title, and for the time since the job began, which stands below that of the training.
    evaluated: label of the line of psnr and ssim.
    """
    # Imported here: it takes a fifth of the time in which an attempt starts, and is needed only at its end.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 6.4), dpi=130)
    panels: tuple[Axes, Axes, Axes] = figure.subplots(
        3, 1, sharex=True, height_ratios=(3, 1.5, 1.4), gridspec_kw=_MARGINS
    )
    psnr, dissimilarity, cost = panels
    for of, color, label in (("train_", TRAINING, "training photos"), ("", ERROR, evaluated)):
        _line(psnr, *_course(curve, f"{of}psnr"), color, label=label)
        times, ssim = _course(curve, f"{of}ssim")
        _line(dissimilarity, times, [max(1.0 - value, LEAST_DISSIMILARITY) for value in ssim], color)
    _line(psnr, *_course(curve, "validation_psnr"), VALIDATION, label="validation photos")
    psnr.set_ylabel("PSNR (dB)")
    dissimilarity.set_ylabel("1 - SSIM")
    if dissimilarity.lines:
        _logarithmic(dissimilarity, "y")
    if psnr.lines:
        rms = psnr.secondary_yaxis("right", functions=(_rms, _decibels))
        rms.set_ylabel("RMS error (of 255)")
        rms.spines["right"].set_visible(False)
    if len(psnr.lines) > 1:
        psnr.legend(loc="upper left", frameon=False, fontsize=9)  # the corner that a rising curve leaves free
    elif psnr.lines:
        psnr.set_ylabel(f"PSNR (dB), {psnr.lines[0].get_label()}")
    scored = [row for row in curve if row["psnr"] is not None]
    if scored:
        last = scored[-1]
        psnr.text(
            0.985,
            0.06,
            f"{last['psnr']:.2f} dB, SSIM {last['ssim']:.3f}",
            transform=psnr.transAxes,
            ha="right",
            fontsize=10,
        )
    _draw_cost(cost, curve)
    times = [row["seconds"] for row in curve]
    if times and min(times) > 0:
        _logarithmic(cost, "x")
    _label_times(cost, sum(seconds.get(stage, 0.0) for stage in BEFORE_TRAINING))
    for axes in panels:
        axes.grid(True, which="major", color="#dddddd", linewidth=0.5)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    stages = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items() if value >= 0.05)
    psnr.set_title(stages, fontsize=8, loc="left", color="#555555")
    with replacing(path) as part:
        figure.savefig(part, format="png")


def _draw_cost(axes: Axes, curve: Sequence[dict[str, Any]]) -> None:
    counts = [row["gaussians"] / 1000.0 for row in curve]
    _line(axes, [row["seconds"] for row in curve], counts, GAUSSIANS)
    axes.set_ylabel("thousand\nGaussians", color=GAUSSIANS)
    axes.set_ylim(0, 1.1 * max(counts, default=1.0) or 1.0)
    resident = [(row["seconds"], row["memory"] / 1e9) for row in curve if row.get("memory")]
    if resident:
        memory = axes.twinx()
        _line(memory, [moment for moment, _ in resident], [size for _, size in resident], MEMORY)
        memory.set_ylabel("memory (GB)", color=MEMORY)
        memory.set_ylim(0, 1.25 * max(size for _, size in resident))  # apart from the Gaussians' line
        memory.spines["top"].set_visible(False)


def _course(curve: Sequence[dict[str, Any]], name: str) -> tuple[list[float], list[float]]:
    """Seconds and values of the points where `name` is known."""
    rows = [row for row in curve if row.get(name) is not None]
    return [row["seconds"] for row in rows], [row[name] for row in rows]


def _line(axes: Axes, x: Sequence[float], y: Sequence[float], color: str = ERROR, label: str = "") -> None:
    if x:
        axes.plot(x, y, "o-", color=color, ms=4 if color == ERROR else 2.5, linewidth=1.6, label=label)


def _rms(psnr: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Root mean square of an error, in grey levels of 255, by its PSNR in dB."""
    rms: npt.NDArray[np.float64] = 255.0 * np.power(10.0, -np.asarray(psnr, np.float64) / 20.0)
    return rms


def _decibels(rms: npt.ArrayLike) -> npt.NDArray[np.float64]:
    psnr: npt.NDArray[np.float64] = -20.0 * np.log10(np.maximum(np.asarray(rms, np.float64), 1e-9) / 255.0)
    return psnr


def _logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """A logarithmic axis with plain numbers at 1, 2 and 5 of every decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log") if which == "x" else axes.set_yscale("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _label_times(axes: Axes, before: float) -> None:
    """Below the training seconds, those since the job began, `before` of which its training did not run."""
    from matplotlib.ticker import FuncFormatter

    if not before:
        axes.set_xlabel("training seconds")
        return
    digits = 0 if before >= 10.0 else 1
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}\n{value + before:.{digits}f}"))
    axes.set_xlabel("training seconds, and below them seconds since the job began")

"""Error against run time as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # a worker has no display
from matplotlib.figure import Figure

QUANTISATION_PSNR = 58.9
"""dB between a photo and its own 8-bit copy: nothing can be measured to be better."""


def draw_curve(
    path: Path,
    curve: Sequence[dict[str, Any]],
    seconds: dict[str, float],
    *,
    measured: str = "held-out PSNR (dB)",
) -> None:
    """PSNR (of what `measured` says) and the number of Gaussians against training seconds.

    Without any PSNR in the curve, the training loss is drawn.
    """
    figure = Figure(figsize=(7.2, 4.0), dpi=130, layout="constrained")
    axes = figure.subplots()
    times = [row["seconds"] for row in curve]
    judged = [row for row in curve if row["psnr"] is not None]
    if judged:
        axes.plot(
            [row["seconds"] for row in judged], [row["psnr"] for row in judged], "o-", color="#1f6f8b", ms=4
        )
        last = judged[-1]
        axes.annotate(
            f"{last['psnr']:.2f} dB, SSIM {last['ssim']:.3f}",
            (last["seconds"], last["psnr"]),
            xytext=(-6, -14),
            textcoords="offset points",
            ha="right",
            fontsize=9,
        )
        axes.set_ylabel(measured)
    else:
        axes.plot(times, [row["loss"] for row in curve], "o-", color="#1f6f8b", ms=4)
        axes.set_ylabel("training loss (no photo was held out)")
    if times and min(times) > 0:
        axes.set_xscale("log")
    axes.set_xlabel("training seconds")
    axes.grid(True, which="both", color="#dddddd", linewidth=0.5)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    counts = axes.twinx()
    counts.plot(times, [row["gaussians"] / 1000.0 for row in curve], color="#c97b3d", linewidth=1, alpha=0.8)
    counts.set_ylabel("thousand Gaussians", color="#c97b3d")
    counts.spines["top"].set_visible(False)
    counts.set_ylim(bottom=0)
    apart = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items() if value >= 0.05)
    axes.set_title(apart, fontsize=8, loc="left", color="#555555")
    figure.savefig(path)

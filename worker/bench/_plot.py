"""The look that the kernel figures share."""

from __future__ import annotations

import statistics
import textwrap
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLORS = {
    "cpu avx512": "#1b6ca8",
    "cpu avx2": "#3fa7d6",
    "cpu baseline": "#8fc7e3",
    "gpu": "#2e8b57",
    "reference float32": "#e08e2b",
    "reference float64": "#7a5c1e",
}
CYCLE = ["#1b6ca8", "#e08e2b", "#2e8b57", "#7a5c1e", "#8e44ad", "#c0392b", "#555555"]
LOSER = "#c0392b"
WINNER = "#2d2d2d"
LETTERS_PER_INCH = 18.0
"""Letters of the footer (7 points, sans serif) that fit an inch; it sets where lines are wrapped."""

plt.rcParams.update(
    {
        "font.size": 10,
        "axes.grid": True,
        "grid.color": "#dddddd",
        "grid.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "figure.dpi": 120,
        "legend.frameon": False,
    }
)


def axes(
    columns: int, lines: int = 1, *, height: float = 4.0, width: float = 5.4, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of panels, line after line; `height` is that of all lines."""
    figure, made = plt.subplots(lines, columns, figsize=(width * columns, height), squeeze=False, **shared)
    return figure, list(made.flat)


def name(panel: Axes, x: str = "", y: str = "", title: str = "", *, log: str = "", size: float = 10) -> None:
    """Labels and title of a panel; `log`: its logarithmic axes, x, y or xy."""
    for axis in log:
        getattr(panel, f"set_{axis}scale")("log")
    for put, text in ((panel.set_xlabel, x), (panel.set_ylabel, y), (panel.set_title, title)):
        if text:
            put(text, fontsize=size)


def middles(panel: Axes, values: dict[float, list[float]], style: str = "-", **look: Any) -> None:
    """A line through the medians of the values at each place."""
    panel.plot(list(values), [statistics.median(x) for x in values.values()], style, **look)


def save(figure: Figure, path: Path, footer: str) -> None:
    path.parent.mkdir(exist_ok=True)
    lines = textwrap.wrap(footer, round(LETTERS_PER_INCH * figure.get_figwidth()))
    figure.tight_layout(rect=(0, 0.01 + 0.03 * len(lines), 1, 1))
    figure.text(0.01, 0.01, "\n".join(lines), fontsize=7, color="#777777")
    figure.savefig(path)
    plt.close(figure)

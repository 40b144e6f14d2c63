"""The look that the kernel figures share."""

from __future__ import annotations

import textwrap
from pathlib import Path

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


def axes(columns: int, *, height: float = 4.0, width: float = 5.4) -> tuple[Figure, list[Axes]]:
    figure, made = plt.subplots(1, columns, figsize=(width * columns, height), squeeze=False)
    return figure, list(made[0])


def save(figure: Figure, path: Path, footer: str) -> None:
    path.parent.mkdir(exist_ok=True)
    lines = textwrap.wrap(footer, round(LETTERS_PER_INCH * figure.get_figwidth()))
    figure.tight_layout(rect=(0, 0.01 + 0.03 * len(lines), 1, 1))
    figure.text(0.01, 0.01, "\n".join(lines), fontsize=7, color="#777777")
    figure.savefig(path)
    plt.close(figure)

"""Error against run time: one point for each budget, every one a run of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import _plot
import numpy as np
from _rows import Row, footer
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from _train.rows import failed, latest_default
from _train.scenes import ALL, COMPARED
from _train.spread import Spread

PEERS = "DP*Xhv<>"
COLORS = {name: f"C{number}" for number, name in enumerate(ALL)}


def draw(rows: list[Row], references: list[Row], path: Path) -> None:
    """Plot held-out PSNR (with the mean squared error on the other axis) and 1 - SSIM over training seconds."""
    timed = [row for row in latest_default(rows) if row["scene"] not in COMPARED]
    figure, (quality, structure) = _plot.axes(2, width=6.4, height=5.0)
    for scene in dict.fromkeys(row["scene"] for row in timed):
        mine = [row for row in timed if row["scene"] == scene and not failed(row) and row["psnr"] is not None]
        if mine:
            lost = sum(failed(row) for row in timed if row["scene"] == scene)
            label = scene + (f" ({lost} failed)" if lost else "")
            course(quality, mine, "psnr", _color(scene), label)
            course(structure, mine, "ssim", _color(scene), label)
    _points(quality, structure, rows, references)
    for panel in (quality, structure):
        panel.set(xscale="log", xlabel="training seconds (cameras, loading and evaluation are not in them)")
        decades(panel.xaxis, (1.0, 3.0))
    quality.set(ylabel="held-out PSNR, dB")
    structure.set(yscale="log", ylabel="held-out 1 - SSIM")
    decades(structure.yaxis)
    error = quality.secondary_yaxis("right", functions=(_mse, _psnr))
    error.set_ylabel("mean squared error that this PSNR stands for")
    decades(error.yaxis)
    if quality.has_data():
        handles, labels = quality.get_legend_handles_labels()
        scenes_first = sorted(range(len(labels)), key=lambda i: "," in labels[i])
        quality.legend(
            [handles[i] for i in scenes_first],
            [labels[i] for i in scenes_first],
            fontsize=7,
            loc="best",
        )
    quality.set_title(
        "points: separate runs, median and range over seeds; thin: the course of the longest", fontsize=8
    )
    structure.set_title("hollow: measured earlier; the floor of 8-bit photos is 58.9 dB", fontsize=8)
    _plot.save(figure, path, footer(timed or rows))


def course(panel: Axes, rows: list[Row], what: str, color: str, label: str) -> None:
    """Plot `what`, psnr or ssim, over the budgets of `rows`, and thinly over the seconds of the longest run."""
    by_budget: dict[str, list[Row]] = {}
    for row in rows:
        by_budget.setdefault(row["budget"], []).append(row)
    places = []
    for group in by_budget.values():
        seconds = Spread.of(row["seconds"]["train"] for row in group)
        value = Spread.of(_value(row, what) for row in group)
        places.append((seconds.median, value))
    places.sort(key=lambda place: place[0])
    x = [place[0] for place in places]
    y = [place[1].median for place in places]
    below = [value.median - value.least for _, value in places]
    above = [value.largest - value.median for _, value in places]
    panel.errorbar(x, y, yerr=[below, above], fmt="o-", color=color, lw=1.8, ms=5, capsize=3, label=label)
    longest = max(rows, key=lambda row: row["seconds"]["train"])
    points = [point for point in longest["curve"] if point["psnr"] is not None and point["seconds"] > 0]
    panel.plot(
        [point["seconds"] for point in points],
        [_value(point, what) for point in points],
        color=color,
        lw=0.7,
        alpha=0.7,
    )


def _points(quality: Axes, structure: Axes, rows: list[Row], references: list[Row]) -> None:
    """Draw the peers: filled where this benchmark evaluated their model, hollow for published figures."""
    judged = {(row["scene"], row["name"]): row for row in rows if row["kind"] == "peer"}
    earlier = [row for row in references if row["kind"] == "reference"]
    drawn = {row["scene"] for row in rows}
    marks = dict(
        zip(
            dict.fromkeys([row["name"] for row in judged.values()] + [row["who"] for row in earlier]),
            PEERS * 4,
            strict=False,
        )
    )
    for row in judged.values():
        style: dict[str, Any] = {
            "marker": marks[row["name"]],
            "color": _color(row["scene"]),
            "s": 60,
            "zorder": 3,
        }
        quality.scatter(row["seconds"], row["psnr"], label=f"{row['scene']}, {row['name']}", **style)
        structure.scatter(row["seconds"], 1.0 - row["ssim"], **style)
    for who in dict.fromkeys(row["who"] for row in earlier):
        mine = [row for row in earlier if row["who"] == who and row["scene"] in drawn]
        for scene in dict.fromkeys(row["scene"] for row in mine):
            of_scene = [row for row in mine if row["scene"] == scene]
            style = {
                "marker": marks[who],
                "facecolors": "none",
                "edgecolors": _color(scene),
                "s": 45,
                "zorder": 3,
            }
            quality.scatter(
                [row["seconds"] for row in of_scene],
                [row["psnr"] for row in of_scene],
                label=f"{scene}, {who} (earlier)",
                **style,
            )
            with_ssim = [row for row in of_scene if "ssim" in row]
            structure.scatter(
                [row["seconds"] for row in with_ssim], [1.0 - row["ssim"] for row in with_ssim], **style
            )


def decades(axis: Axis, at: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Set ticks at the same positions of every decade, labelled with plain numbers."""
    axis.set_major_locator(LogLocator(subs=at))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _value(row: Row, what: str) -> float:
    return 1.0 - float(row["ssim"]) if what == "ssim" else float(row["psnr"])


def _color(scene: str) -> str:
    return COLORS.get(scene, "#555555")


def _mse(psnr: Any) -> Any:
    return 10.0 ** (-np.asarray(psnr, float) / 10.0)


def _psnr(mse: Any) -> Any:
    return -10.0 * np.log10(np.maximum(np.asarray(mse, float), 1e-30))

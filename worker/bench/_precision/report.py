# ruff: noqa: E501  (rows of Markdown tables are as long as they are)
"""The table and the Pareto figure of `bench precision`."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from pathlib import Path

import _plot
from _rows import Row, footer

from _precision.variants import PLAIN, VARIANTS, Variant

COLORS = {"shipped": "#2d2d2d", "records": "#1b6ca8", "harmonics": "#2e8b57", "moments": "#c0392b", "tile": "#7a5c1e",
          "cut": "#e08e2b", "end": "#8e44ad"}  # fmt: skip

HALF_STEP = 0.5
"""Of an 8-bit picture: what rounding to it may change."""


NEAR = 0.03
"""Labels of points that are nearer to one another along the time axis are stacked."""


class Found:
    """The rows of one file, by what they measured."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self.rows = list(rows)
        last: dict[tuple[object, ...], Row] = {}
        for row in self.rows:  # what was measured again replaces what was there
            key = (
                row["kind"],
                row["variant"],
                row.get("scene"),
                row.get("threads"),
                row.get("seed"),
                row["steps"] if row["kind"] in ("decay", "training") else None,
            )
            last[key] = row
        self.last = list(last.values())

    def of(self, kind: str, variant: Variant) -> list[Row]:
        """The rows of a variant."""
        return [r for r in self.last if r["kind"] == kind and r["variant"] == variant.name]

    def variants(self, kind: str) -> list[Variant]:
        """The variants that have rows of a kind."""
        return [v for v in VARIANTS if self.of(kind, v)]

    def ratio(self, variant: Variant, clock: str = "cpu") -> float:
        """Time of a step over that of float32: the geometric mean over scenes and threads."""
        found = [r[f"{clock}_ratio"] for r in self.of("time", variant)]
        return math.exp(statistics.fmean(math.log(x) for x in found)) if found else math.nan

    def error(self, variant: Variant, name: str) -> float:
        """The mean over scenes of an error of the image, or of the worst group's error of the gradient."""
        found = [r[name] for r in self.of("error", variant)]
        values = [max(x.values()) if isinstance(x, dict) else x for x in found]
        return statistics.fmean(values) if values else math.nan

    def gains(self, variant: Variant, scene: str | None = None) -> list[float]:
        """Held-out PSNR minus that of float32 with the same scene and seed, dB."""
        plain = {(r["scene"], r["seed"]): r for r in self.of("training", PLAIN)}
        return [
            r["psnr"] - plain[r["scene"], r["seed"]]["psnr"]
            for r in self.of("training", variant)
            if scene in (None, r["scene"])
            and (r["scene"], r["seed"]) in plain
            and None not in (r.get("psnr"), plain[r["scene"], r["seed"]].get("psnr"))
        ]


def spread(values: list[float]) -> float:
    """Standard error of the mean."""
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def draw(rows: list[Row], path: Path) -> None:
    """Time against the error of images, the error of gradients, and the change of PSNR."""
    found = Found(rows)
    figure, panels = _plot.axes(3, width=5.0, height=4.6)
    timed = found.variants("time")
    titles = (
        "image: mean error, 8-bit steps",
        "gradient: worst group, error / norm",
        "held-out PSNR - that of float32, dB",
    )
    for panel, title in zip(panels, titles, strict=True):
        panel.set_title(title, fontsize=10)
        panel.set_xlabel("CPU time of a step / that of float32")
        panel.axvline(1.0, color="#bbbbbb", lw=0.8)
        panel.margins(x=0.25, y=0.15)
    for variant in timed:
        x = found.ratio(variant)
        gains = found.gains(variant)
        ys = (
            found.error(variant, "image"),
            found.error(variant, "gradient"),
            statistics.fmean(gains) if gains else math.nan,
        )
        for panel, y in zip(panels, ys, strict=True):
            if math.isnan(y) or (panel is not panels[2] and y == 0):  # no place on a logarithmic axis
                continue
            if panel is panels[2]:
                panel.errorbar(
                    x,
                    y,
                    yerr=0.0 if variant is PLAIN else spread(gains),
                    fmt="o",
                    color=COLORS[variant.kind],
                    ms=5,
                    lw=1,
                )
            else:
                panel.plot(x, y, "o", color=COLORS[variant.kind], ms=6)
            crowd = sum(abs(text.xy[0] - x) < NEAR for text in panel.texts)  # type: ignore[attr-defined]  # annotations
            offset = (6, 3 + 9 * crowd)
            color = COLORS[variant.kind]
            panel.annotate(
                short(variant), (x, y), fontsize=7, color=color, xytext=offset, textcoords="offset points"
            )
    for panel in panels[:2]:
        if panel.texts:
            panel.set_yscale("log")
    panels[0].axhline(HALF_STEP, color="#bbbbbb", lw=0.8, ls=":")
    panels[2].axhline(0.0, color="#bbbbbb", lw=0.8)
    _plot.save(figure, path, footer(rows))


def short(variant: Variant) -> str:
    """The name as figures show it."""
    return variant.name.replace("_", " ")


def table(rows: list[Row]) -> str:
    """The report."""
    found = Found(rows)
    out = ["# Precision against time", "",
           "Generated by `splatmill bench precision` from `results/precision.jsonl`; what was expected stands in the command's "
           "description. Every variant is a build of the C++ kernels of its own. Times are ratios to float32 in the same round, of one process "
           "in turning order; CPU seconds are given beside wall seconds because the machine was shared. Errors are against blending that "
           "leaves nothing out (cut at 2^-20, end at 1e-9), on held-out views of scenes that float32 trained.", "",
           "![Time against error and PSNR](figures/precision.png)", ""]  # fmt: skip
    out += times(found) + errors(found) + quality(found) + decays(found)
    return "\n".join([*out, footer(rows), ""])


def times(found: Found) -> list[str]:
    """The table of times."""
    plain = found.of("time", PLAIN)
    if not plain:
        return []
    out = ["## Time of a training step", "", "CPU time over that of float32 in the same round, median and quartiles; in brackets wall time.", "",
           "| variant | " + " | ".join(f"{r['gaussians'] // 1000}k, {r['threads']} thread{'s' * (r['threads'] > 1)}" for r in plain) + " |",
           "|---" * (1 + len(plain)) + "|",
           "| float32, ms (CPU; wall) | " + " | ".join(f"{r['cpu_ms']:.1f}; {r['wall_ms']:.1f}" for r in plain) + " |"]  # fmt: skip
    for variant in found.variants("time"):
        if variant is PLAIN:
            continue
        cells = []
        for p in plain:
            mine = [
                r
                for r in found.of("time", variant)
                if (r["scene"], r["threads"]) == (p["scene"], p["threads"])
            ]
            cells += [
                f"{r['cpu_ratio']:.3f} ({r['cpu_quartiles'][0]:.3f} to {r['cpu_quartiles'][1]:.3f}) [{r['wall_ratio']:.2f}]"
                for r in mine
            ] or [""]
        out.append(f"| {variant.text} | " + " | ".join(cells) + " |")
    return [*out, ""]


def errors(found: Found) -> list[str]:
    """The table of errors."""
    shown = [v for v in found.variants("error") if v.kind != "moments"]
    if not shown:
        return []
    out = ["## Error", "", "Means over the scenes. Moments change neither images nor gradients.", "",
           "| variant | image, mean, 8-bit steps | 99.9 % below | gradient, worst group | image, from float32 | gradient, from float32 |",
           "|---|---|---|---|---|---|"]  # fmt: skip
    names = ("image", "image_p999", "gradient", "image_float32", "gradient_float32")
    for variant in shown:
        out.append(
            f"| {variant.text} | " + " | ".join(f"{found.error(variant, n):.2g}" for n in names) + " |"
        )
    return [*out, ""]


def quality(found: Found) -> list[str]:
    """The table of trainings."""
    plain = found.of("training", PLAIN)
    if not plain:
        return []
    scenes = list(dict.fromkeys(r["scene"] for r in plain))
    first = plain[0]
    seeds = len({r["seed"] for r in plain})
    out = ["## Held-out PSNR after a short training", "",
           f"{first['steps']} steps, photos of {first['size']} pixels, {seeds} seed{'s' * (seeds > 1)}. Differences to float32 with the same seed, in dB; the mean is over scenes and seeds, with its "
           "standard error. Any change of rounding changes which Gaussians are split, so that two trainings differ by chance: "
           "the error of the mean says by how much.", "",
           "| variant | " + " | ".join(scenes) + " | mean |", "|---" * (2 + len(scenes)) + "|",
           "| float32, dB | " + " | ".join(f"{statistics.fmean(r['psnr'] for r in plain if r['scene'] == s):.2f}" for s in scenes) + " | |"]  # fmt: skip
    for variant in found.variants("training"):
        if variant is PLAIN:
            continue
        cells = [f"{statistics.fmean(g):+.2f}" if (g := found.gains(variant, s)) else "" for s in scenes]
        gains = found.gains(variant)
        error = f" ± {spread(gains):.3f}" if len(gains) > 1 else ""
        mean = f"{statistics.fmean(gains):+.3f}{error} ({len(gains)})" if gains else ""
        out.append(f"| {variant.text} | " + " | ".join(cells) + f" | {mean} |")
    return [*out, ""]


def decays(found: Found) -> list[str]:
    """The table of second moments out of view."""
    shown = found.variants("decay")
    if not shown:
        return []
    after = sorted({r["steps"] for v in shown for r in found.of("decay", v)})
    exact = {r["steps"]: r["exact"] for r in found.of("decay", shown[0])}
    out = ["## Second moments of Gaussians out of view", "",
           "Their mean share of what they were after so many steps with a gradient of zero; in brackets the share of values that have not moved at all.", "",
           "| variant | " + " | ".join(f"{t} steps" for t in after) + " |", "|---" * (1 + len(after)) + "|",
           f"| exact, {exact[after[0]] ** (1 / after[0]):.4g}^n | " + " | ".join(f"{exact[t]:.4f}" for t in after) + " |"]  # fmt: skip
    for variant in shown:
        by = {r["steps"]: r for r in found.of("decay", variant)}
        out.append(
            f"| {variant.text} | "
            + " | ".join(f"{by[t]['share']:.4f} ({by[t]['unmoved']:.0%})" for t in after)
            + " |"
        )
    return [*out, ""]

# ruff: noqa: E501  (heads of tables are as long as they are)
"""What narrower storage and rougher blending save, and what they cost in exactness and in held-out PSNR.

    splatmill bench precision                              # compiles the variants, then every part: over an hour
    splatmill bench precision --only time error decay      # what needs no training but one of each scene
    splatmill bench precision --variants moments_nearest --only decay

Each variant is a build of the C++ kernels with other compile definitions (`_studies/precision/variants.py`), made for
the instruction set in use, in a folder of the benchmark; the installed engine is not touched. All are measured in one
process, in turning order. Trainings that have a row of the present code are not repeated.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import _plot
import _scenes
from _page import table
from _rows import HERE, Row, distinct, footer, of
from _studies.precision.builds import compiled
from _studies.precision.measure import decay, errors, timed
from _studies.precision.trainings import settled, trained
from _studies.precision.variants import BY_NAME, EXACT, PLAIN, VARIANTS, Variant
from _studies.study import Study
from _train import scenes
from _train.child import prepared
from _train.rows import code_version
from matplotlib.figure import Figure

CACHE = HERE.parent / "build" / "precision"
SCENES = ("synthetic", "fox", "lund", "lego")
AFTER = (1, 10, 100, 250, 500, 1000, 2000)
"""Steps out of view after which second moments are read."""

COUNTS = (None, 30_000, 100_000)
"""Gaussians of the fox that steps are timed on; None: its SfM points, 11,000."""

HALF_STEP = 0.5
"""Of an 8-bit picture: what rounding to it may change."""

NEAR = 0.03
"""Labels of points that are nearer to one another along the time axis are stacked."""

COLORS = {"shipped": "#2d2d2d", "records": "#1b6ca8", "harmonics": "#2e8b57", "moments": "#c0392b", "tile": "#7a5c1e",
          "cut": "#e08e2b", "end": "#8e44ad"}  # fmt: skip

Options = argparse.Namespace


def chosen(options: Options) -> list[Variant]:
    return [v for v in VARIANTS if not options.variants or v is PLAIN or v.name in options.variants]


def measure_decays(options: Options) -> Iterator[Row]:
    moving = [v for v in chosen(options) if v.kind in ("shipped", "moments")]
    modules = compiled(moving, options.work)
    for variant in moving:
        yield from decay(variant, modules, AFTER)


def measure_errors(options: Options) -> Iterator[Row | str]:
    modules = compiled([*chosen(options), EXACT], options.work)
    training = {"steps": options.steps, "image_size": options.size}
    for capture in captures(options):
        if isinstance(capture, str):
            yield capture
        else:
            yield from errors(settled(capture, training, options.work), chosen(options), modules)


def measure_times(options: Options) -> Iterator[Row]:
    """On the fox at growing numbers of Gaussians; without the shared photos, on a cloud."""
    modules = compiled(chosen(options), options.work)
    for count in COUNTS:
        scene = _scenes.fox(480, count) or _scenes.cloud(count or 11_000, 270, 480)
        scene.views = scene.views[:: max(1, len(scene.views) // options.views)][: options.views]
        for threads in options.threads:
            yield from timed(scene, chosen(options), modules, threads, options.rounds)


def measure_trainings(options: Options) -> Iterator[Row | str]:
    modules = compiled(chosen(options), options.work)
    training = {"steps": options.steps, "image_size": options.size}
    found = list(captures(options))
    yield from (reason for reason in found if isinstance(reason, str))
    there = [capture for capture in found if not isinstance(capture, str)]
    for seed, capture, variant in product(range(options.seeds), there, chosen(options)):
        named = {"variant": variant.name, "scene": capture.name, "seed": seed, "size": options.size,
                 "steps": options.steps, "code": code_version()}  # fmt: skip
        if not of(options.known, kind="training", **named):
            yield trained(capture, variant, modules, seed, training, options.work)


def captures(options: Options) -> Iterator[scenes.Scene | str]:
    """The scenes with their cameras; a sentence for each that is not there."""
    for name in options.scenes:
        try:
            scene = scenes.named(name, options.work)
        except FileNotFoundError as absent:
            yield str(absent)
            continue
        prepared(scene, options.work)
        yield scene


# ---- what follows from rows


def of_variant(rows: list[Row], kind: str, variant: Variant) -> list[Row]:
    return of(rows, kind=kind, variant=variant.name)


def variants(rows: list[Row], kind: str) -> list[Variant]:
    """The variants that have rows of a kind."""
    return [v for v in VARIANTS if of_variant(rows, kind, v)]


def ratio(rows: list[Row], variant: Variant) -> float:
    """CPU time of a step over that of float32: the geometric mean over scenes and threads."""
    return math.exp(statistics.fmean(math.log(r["cpu_ratio"]) for r in of_variant(rows, "time", variant)))


def error(rows: list[Row], variant: Variant, name: str) -> float:
    """The mean over scenes of an error of the image, or of the worst group's error of the gradient."""
    found = [r[name] for r in of_variant(rows, "error", variant)]
    return mean([max(x.values()) if isinstance(x, dict) else x for x in found])


def gains(rows: list[Row], variant: Variant, scene: str | None = None) -> list[float]:
    """Held-out PSNR minus that of float32 with the same scene and seed, dB."""
    plain = {(r["scene"], r["seed"]): r.get("psnr") for r in of_variant(rows, "training", PLAIN)}
    return [
        r["psnr"] - plain[r["scene"], r["seed"]]
        for r in of_variant(rows, "training", variant)
        if scene in (None, r["scene"]) and None not in (r.get("psnr"), plain.get((r["scene"], r["seed"])))
    ]


def mean(values: list[float]) -> float:
    return statistics.fmean(values) if values else math.nan


def spread(values: list[float]) -> float:
    """Standard error of the mean."""
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def draw(rows: list[Row]) -> Figure:
    """Time against the error of images, the error of gradients, and the change of PSNR."""
    figure, panels = _plot.axes(3, width=5.0, height=4.6)
    titles = (
        "image: mean error, 8-bit steps",
        "gradient: worst group, error / norm",
        "held-out PSNR - that of float32, dB",
    )
    for panel, title in zip(panels, titles, strict=True):
        _plot.name(panel, "CPU time of a step / that of float32", title=title)
        panel.axvline(1.0, color="#bbbbbb", lw=0.8)
        panel.margins(x=0.25, y=0.15)
    for variant in variants(rows, "time"):
        x, color, gained = ratio(rows, variant), COLORS[variant.kind], gains(rows, variant)
        ys = error(rows, variant, "image"), error(rows, variant, "gradient"), mean(gained)
        for panel, y in zip(panels, ys, strict=True):
            if math.isnan(y) or (panel is not panels[2] and y == 0):  # no place on a logarithmic axis
                continue
            if panel is panels[2]:
                off = 0.0 if variant is PLAIN else spread(gained)
                panel.errorbar(x, y, yerr=off, fmt="o", color=color, ms=5, lw=1)
            else:
                panel.plot(x, y, "o", color=color, ms=6)
            crowd = sum(abs(text.xy[0] - x) < NEAR for text in panel.texts)  # type: ignore[attr-defined]  # annotations
            panel.annotate(
                variant.name.replace("_", " "), (x, y), fontsize=7, color=color, xytext=(6, 3 + 9 * crowd),
                textcoords="offset points",
            )  # fmt: skip
    for panel in panels[:2]:
        if panel.texts:
            panel.set_yscale("log")
    panels[0].axhline(HALF_STEP, color="#bbbbbb", lw=0.8, ls=":")
    panels[2].axhline(0.0, color="#bbbbbb", lw=0.8)
    return figure


def times(rows: list[Row]) -> str:
    plain = of_variant(rows, "time", PLAIN)
    lines = [["float32, ms (CPU; wall)", *(f"{r['cpu_ms']:.1f}; {r['wall_ms']:.1f}" for r in plain)]]
    for variant in variants(rows, "time")[1:]:
        mine = [of(of_variant(rows, "time", variant), scene=p["scene"], threads=p["threads"]) for p in plain]
        cells = [
            f"{r[0]['cpu_ratio']:.3f} ({r[0]['cpu_quartiles'][0]:.3f} to {r[0]['cpu_quartiles'][1]:.3f}) [{r[0]['wall_ratio']:.2f}]"
            if r
            else ""
            for r in mine
        ]
        lines.append([variant.text, *cells])
    head = [f"{r['gaussians'] // 1000}k, {r['threads']} thread{'s' * (r['threads'] > 1)}" for r in plain]
    return table("|".join(["variant", *head]), lines)


def errors_table(rows: list[Row]) -> str:
    names = {
        "image": "image, mean, 8-bit steps",
        "image_p999": "99.9 % below",
        "gradient": "gradient, worst group",
        "image_float32": "image, from float32",
        "gradient_float32": "gradient, from float32",
    }
    shown = [v for v in variants(rows, "error") if v.kind != "moments"]
    lines = [[v.text, *(f"{error(rows, v, name):.2g}" for name in names)] for v in shown]
    return table("|".join(["variant", *names.values()]), lines)


def trainings(rows: list[Row]) -> str:
    plain = of_variant(rows, "training", PLAIN)
    if not plain:
        return ""
    seeds = len({r["seed"] for r in plain})
    shown = distinct(plain, "scene")
    text = (
        f"{plain[0]['steps']} steps, photos of {plain[0]['size']} pixels, {seeds} seed{'s' * (seeds > 1)}. Differences to float32 with the same seed, in dB; the mean is over scenes and seeds, with its "
        "standard error. Any change of rounding changes which Gaussians are split, so that two trainings differ by chance: "
        "the error of the mean says by how much."
    )
    lines = [["float32, dB", *(f"{mean([r['psnr'] for r in of(plain, scene=s)]):.2f}" for s in shown), ""]]
    for variant in variants(rows, "training")[1:]:
        cells = [f"{mean(g):+.2f}" if (g := gains(rows, variant, s)) else "" for s in shown]
        every = gains(rows, variant)
        off = f" ± {spread(every):.3f}" if len(every) > 1 else ""
        lines.append([variant.text, *cells, f"{mean(every):+.3f}{off} ({len(every)})" if every else ""])
    return f"{text}\n\n{table('|'.join(['variant', *shown, 'mean']), lines)}"


def decays(rows: list[Row]) -> str:
    shown = variants(rows, "decay")
    if not shown:
        return ""
    exact = {r["steps"]: r["exact"] for r in sorted(of(rows, kind="decay"), key=lambda r: int(r["steps"]))}
    first = min(exact)
    lines = [[f"exact, {exact[first] ** (1 / first):.4g}^n", *(f"{x:.4f}" for x in exact.values())]]
    for variant in shown:
        by = {r["steps"]: r for r in of_variant(rows, "decay", variant)}
        lines.append([variant.text, *(f"{by[t]['share']:.4f} ({by[t]['unmoved']:.0%})" for t in exact)])
    return table("|".join(["variant", *(f"{t} steps" for t in exact)]), lines)


STUDY = Study(
    name="precision",
    about=__doc__,
    cases={
        "decay": measure_decays, "error": measure_errors, "time": measure_times, "training": measure_trainings,
    },
    key=("kind", "variant", "scene", "threads", "seed", "steps"),
    blocks={"times": times, "errors": errors_table, "trainings": trainings, "decays": decays, "footer": footer},
    figures={"precision": draw},
    options={
        "variants": {"nargs": "+", "choices": BY_NAME, "help": "these variants, beside float32"},
        "scenes": {"nargs": "+", "default": SCENES, "help": "scenes of bench train, or folders"},
        "steps": {"type": int, "default": 400, "help": "of each training"},
        "size": {"type": int, "default": 240, "help": "longest side of the photos in trainings, pixels"},
        "seeds": {"type": int, "default": 3},
        "rounds": {"type": int, "default": 9},
        "views": {"type": int, "default": 12, "help": "views of a round of timings"},
        "threads": {"type": int, "nargs": "+", "default": [1, 2]},
        "work": {"type": Path, "default": CACHE, "help": "builds, photos and recovered cameras"},
    },
)  # fmt: skip
main = STUDY.main

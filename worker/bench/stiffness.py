# ruff: noqa: E501  (heads of tables are as long as they are)
"""How near training is to the stability limit of Adam, at boosts of the rates from 1 to 256.

    splatmill bench stiffness                             # everything: about 40 minutes of one core
    splatmill bench stiffness --only curvature --scenes fox
    splatmill bench stiffness --only runs --longest 480 --steps 120 --boosts 4 8 16 --seeds 0 1

Cases: `needles` (Gauss-Newton blocks), `curvature` (largest eigenvalue of Adam's preconditioned Hessian over a
training), `products` (how exact the Hessian's products are), `runs` (the same trainings at boosts of the rates),
`groups` (boost of 8, and four times that for one group) and `recovery` (a jump of all rates in the midst of a
training). No figure is a time.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterable, Iterator
from functools import partial, reduce
from itertools import chain
from operator import getitem
from pathlib import Path
from typing import Any

import _plot
from _page import Column, of_rows, table
from _rows import HERE, Row, distinct, of
from _studies.stiffness import needles
from _studies.stiffness.curvature import COLUMNS
from _studies.stiffness.products import Sampled
from _studies.stiffness.runs import ALL, Probe, training
from _studies.stiffness.scenes import Small, absence, load
from _studies.study import Case, Study, generated
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from splatmill_worker.splat.plan.rates import MOST_BOOST

CACHE = HERE.parent / "build" / "bench"
SCENES = ["synthetic", "fox", "lund", "lego"]

CURVATURE_STEPS, CURVATURE_LONGEST, MOST = 240, 96, 2000
"""Steps, longest side of photos in pixels, and most Gaussians of the trainings whose Hessian is measured."""

CURVATURE_BOOSTS = [1.0, 4.0, 8.0, 16.0, 32.0]
SHARES = [0.1, 0.5]
"""Shares of the budget at which the Hessian is measured. Rates fall after 0.6."""

LONGEST = 160
"""Longest side of the photos of the runs, pixels."""

STEPS = {120: [0, 1, 2], 480: [0, 1]}
"""Seeds by number of steps; the boost of the plan is 8 (15.8 without its limit) and 7.9."""

BOOSTS = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
EXTREME = [64.0, 128.0, 256.0]
"""Boosts at which runs are made to see how they fail, with the first seed and the steps of EXTREME_STEPS."""

EXTREME_STEPS = 480
GROUP_FACTOR = 4.0
RECOVERY_AFTER, RECOVERY_FACTORS = 300, [2.0, 4.0, 16.0, 64.0]
"""Steps after which all rates of a training of EXTREME_STEPS are multiplied, and by how much: the loss is watched
from step 260 on."""

Options = argparse.Namespace


def of_scenes(rows: Callable[[Options, Small], Iterable[Row]], longest: int) -> Case:
    """A case that goes over the scenes."""

    def measure(options: Options) -> Iterator[Row | str]:
        for name in options.scenes:
            reason = absence(name)
            if reason is not None:
                yield reason
                continue
            yield from rows(options, load(name, options.longest or longest, options.work))

    return measure


def curvature(options: Options, small: Small) -> Iterator[Row]:
    steps, seed = options.steps or CURVATURE_STEPS, options.seeds[0]
    for boost in options.boosts or CURVATURE_BOOSTS:
        probe = Probe(small, options.shares)
        run = training(small, steps, boost, seed, most=options.most, probe=probe)
        for row in probe.rows:
            yield {
                "scene": small.name, "longest": small.longest, "steps": steps, "boost": boost, "seed": seed,
                "outcome": run["outcome"], "recoveries": run["recoveries"], **row,
            }  # fmt: skip


def products(options: Options, small: Small) -> Iterator[Row]:
    probe = Sampled(small, options.shares[-1:])
    training(small, options.steps or CURVATURE_STEPS, 8.0, options.seeds[0], most=options.most, probe=probe)
    yield from ({"scene": small.name, "longest": small.longest, **row} for row in probe.rows)


def runs(options: Options, small: Small) -> Iterator[Row]:
    for steps, seeds in ({options.steps: options.seeds} if options.steps else STEPS).items():
        for seed in seeds:
            boosts = options.boosts or BOOSTS + (EXTREME if (steps, seed) == (EXTREME_STEPS, 0) else [])
            yield from (training(small, steps, boost, seed) for boost in boosts)


def groups(options: Options, small: Small) -> Iterator[Row]:
    for group in COLUMNS:
        yield training(
            small, options.steps or min(STEPS), 8.0, options.seeds[0], group=group, by=GROUP_FACTOR
        )


def recovery(options: Options, small: Small) -> Iterator[Row]:
    for by in RECOVERY_FACTORS:
        yield training(small, EXTREME_STEPS, 8.0, options.seeds[0], group=ALL, by=by, after=RECOVERY_AFTER)


# ---- what follows from rows


def middle(values: Iterable[float]) -> float:
    return statistics.median(list(values))


def by_boost(rows: list[Row], *path: str) -> dict[float, list[float]]:
    """The values of a field, or of a field in a field, of all rows of each boost."""
    boosts = sorted({row["boost"] for row in rows})
    value: Any = partial(reduce, getitem, path)
    return {boost: [value(row) for row in of(rows, boost=boost)] for boost in boosts}


def losses(rows: list[Row]) -> dict[tuple[int, int], dict[float, list[float]]]:
    """By longest side and steps, and by boost: for each scene, the best boost's median PSNR over seeds less this one's."""
    trained = [row for row in of(rows, part="runs", group=None) if row.get("psnr") is not None]
    by_size: dict[tuple[int, int], dict[float, list[float]]] = {}
    for longest, steps in dict.fromkeys((row["longest"], row["steps"]) for row in trained):
        mine = of(trained, longest=longest, steps=steps)
        below = by_size[longest, steps] = {}
        for scene in distinct(mine, "scene"):
            of_scene = of(mine, scene=scene)
            medians = {
                boost: middle(row["psnr"] for row in of(of_scene, boost=boost))
                for boost in distinct(of_scene, "boost")
            }
            for boost, psnr in medians.items():
                below.setdefault(boost, []).append(max(medians.values()) - psnr)
    return by_size


def spread(values: dict[float, list[float]], digits: str) -> str:
    """Median and range by boost, in words."""
    return ", ".join(
        f"{middle(x):{digits}} at {b:g} ({min(x):{digits}} to {max(x):{digits}})"
        for b, x in sorted(values.items())
    )


def summary(rows: list[Row]) -> str:
    """The answer in figures: the eigenvalue half way by boost, and what the same boosts cost in quality."""
    half = [row for row in of(rows, part="curvature") if 0.4 < row["share"] < 0.6]
    sentences = []
    if half:
        eigenvalues = spread(by_boost(half, "ratio"), ".2g")
        sentences.append(
            f"Half way through a training, the largest eigenvalue over its limit is {eigenvalues}; median and range over the scenes ({len(distinct(half, 'scene'))}), by boost."
        )
    sentences += [
        f"After {steps} steps at {longest} pixels, the held-out PSNR is below the scene's best by, in dB: {spread(below, '.2f')}."
        for (longest, steps), below in losses(rows).items()
    ]
    return " ".join(sentences)


# ---- tables


def lead(field: str) -> Callable[[Row], str]:
    """The group with the largest share, and the share."""

    def cell(row: Row) -> str:
        name, share = max(row[field].items(), key=lambda each: each[1])
        return f"{name} {100 * share:.0f} %"

    return cell


def optional(field: str, form: str, without: str = "") -> Callable[[Row], str]:
    return lambda row: without if row.get(field) is None else f"{row[field]:{form}}"


def curvature_table(rows: list[Row]) -> str:
    columns: list[Column] = [
        ("scene", "{scene}"), ("boost", "{boost:g}"), ("step", "{step}"), ("Gaussians", "{gaussians}"),
        ("eigenvalue / 38", "{ratio:.2g} ± {error:.1g}"), ("directions beyond 38", "{beyond:.0e}"),
        ("of single photos", lambda row: " ".join(f"{x:.2g}" for x in sorted(row["photos"]))),
        ("leading group", lead("groups")), ("in the mean square", "{stochastic:.2g}"),
        ("leading group", lead("stochastic_groups")), ("photos that see it", "{seen_by:.1f}"), ("Gaussians in it", "{shared_by:.1f}"),
        ("each group alone, mean square", lambda row: " ".join(f"{name} {value:.2g}" for name, value in row["alone"].items())),
        ("gain, mean loss", optional("gain", ".2f", "-")), ("gain, own photo", optional("own", ".2f", "-")),
    ]  # fmt: skip
    return of_rows(columns, of(rows, part="curvature"))


def products_table(rows: list[Row]) -> str:
    what = {
        "float64": "float64, differentiated twice",
        "share": "length of the difference, steps",
        "width": "rounding of |r|, grey levels",
    }
    columns: list[Column] = [
        ("scene", "{scene}"), ("product", lambda row: what[row["sweep"]]), ("value", optional("value", "g")),
        ("eigenvalue / limit", "{largest:.3f}"), ("asymmetry", optional("asymmetry", ".1e")), ("off float64", optional("off", ".1e")),
    ]  # fmt: skip
    return of_rows(columns, of(rows, part="products"))


def runs_table(rows: list[Row]) -> str:
    """Medians over seeds."""

    def of_done(field: str, form: str, unit: str = "", factor: int = 1) -> Callable[[Row], str]:
        def cell(row: Row) -> str:
            done = [each for each in row["seeds"] if "psnr" in each]
            return f"{factor * middle(each[field] for each in done):{form}}{unit}" if done else "-"

        return cell

    def total(field: str) -> Callable[[Row], int]:
        return lambda row: sum(each[field] for each in row["seeds"])

    columns: list[Column] = [
        ("scene", "{scene}"), ("pixels", "{longest}"), ("steps", "{steps}"), ("boost", "{boost:g}"), ("seeds", lambda row: len(row["seeds"])),
        ("held-out PSNR dB", of_done("psnr", ".2f")), ("training PSNR dB", of_done("train_psnr", ".2f")), ("last loss", of_done("loss", ".4f")),
        ("Gaussians", of_done("gaussians", ".0f")), ("axis ratio", of_done("axis_ratio", ".1f")),
        ("larger than the scene", of_done("wide", ".2f", " %", 100)), ("roll-backs", total("recoveries")), ("refused values", total("refused")),
        ("failed", lambda row: sum(each["outcome"] != "trained" for each in row["seeds"])),
    ]  # fmt: skip
    plain = of(rows, part="runs", group=None)
    names = ("scene", "longest", "steps", "boost")
    keys = [
        dict(zip(names, key, strict=True)) for key in dict.fromkeys(tuple(r[n] for n in names) for r in plain)
    ]
    return of_rows(columns, [{**key, "seeds": of(plain, **key)} for key in keys])


def groups_table(rows: list[Row]) -> str:
    """What changes where one group's rate, or all, are multiplied, against the run with the plan's rates."""

    def change(field: str) -> Callable[[Row], str]:
        def cell(row: Row) -> str:
            same = {name: row[name] for name in ("part", "scene", "longest", "steps", "boost", "seed")}
            base = [each for each in of(rows, group=None, **same) if field in each]
            return f"{row[field] - base[0][field]:+.2f}" if base and field in row else "-"

        return cell

    columns: list[Column] = [
        ("scene", "{scene}"), ("steps", "{steps}"), ("group", "{group}"), ("factor", "{by:g}"), ("from step", lambda row: row.get("after", 0)),
        ("held-out dB", change("psnr")), ("training dB", change("train_psnr")), ("roll-backs", "{recoveries}"), ("refused values", "{refused}"),
        ("outcome", lambda row: "trained" if row["outcome"] == "trained" else "failed"),
    ]  # fmt: skip
    return of_rows(columns, [row for row in of(rows, part="runs") if row["group"] is not None])


def warnings_list(rows: list[Row]) -> str:
    """What the user was told, for runs that were rolled back or failed."""
    lines = []
    for row in of(rows, part="runs"):
        if row["warnings"] or row["outcome"] != "trained":
            name = f"{row['scene']}, {row['steps']} steps, boost {row['boost']:g}"
            name += f", {row['group']} times {row['by']:g}" if row["group"] else f", seed {row['seed']}"
            lines.append(f"- {name}: {' / '.join([*row['warnings'], row['outcome']])}")
    return "\n".join(lines) or "None."


def needles_table(rows: list[Row]) -> str:
    mine = of(rows, part="needles")
    lines = [
        [f"{ratio:g}", *(f"{r['largest']:.3g}, {r['condition']:.1e}" for r in of(mine, ratio_of=ratio))]
        for ratio in distinct(mine, "ratio_of")
    ]
    head = ["axis ratio", *(f"{name}: largest, condition" for name in distinct(mine, "metric"))]
    return table("|".join(head), lines)


# ---- the figure


def draw(rows: list[Row]) -> Figure:
    """Four panels: the eigenvalue over its limit, the same by group, quality, and needles."""
    figure, panels = _plot.axes(2, 2, width=5.75, height=8.2)
    half = [row for row in of(rows, part="curvature") if row["share"] > 0.4]
    draw_ratio(panels[0], half)
    draw_groups(panels[1], half)
    draw_quality(panels[2], losses(rows))
    draw_needles(panels[3], of(rows, part="needles"))
    for panel in panels:
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=7)
    for panel in panels[:2]:
        panel.axhline(1.0, color=_plot.LOSER)
        panel.set_yscale("log")
    for panel in panels[:3]:
        panel.set_xscale("log", base=2)
        panel.axvline(MOST_BOOST, color="#888888", lw=1, ls="--")
        panel.set_xlabel("boost of the learning rates (dashed: MOST_BOOST)")
    return figure


def draw_ratio(panel: Axes, rows: list[Row]) -> None:
    for color, scene in zip(_plot.CYCLE, distinct(rows, "scene"), strict=False):
        for field, style, marker, label in (
            ("ratio", "-", "o", "mean of the photos / 38"),
            ("stochastic", ":", ".", "in the mean square"),
        ):
            ratios = by_boost(of(rows, scene=scene), field)
            _plot.middles(panel, ratios, style, marker=marker, color=color, label=f"{scene}: {label}")
    title = "Adam's preconditioned Hessian, half way through a training"
    _plot.name(panel, y="largest eigenvalue / stability limit", title=title)


def draw_groups(panel: Axes, rows: list[Row]) -> None:
    names = dict.fromkeys(chain.from_iterable(row["alone"] for row in rows))
    for color, name in zip(_plot.CYCLE, names, strict=False):
        mine = [row for row in rows if row["alone"].get(name, 0.0) > 0]
        if mine:
            _plot.middles(panel, by_boost(mine, "alone", name), marker="o", color=color, label=name)
    title = "each group alone, half way (median over scenes)"
    _plot.name(panel, y="growth in the mean square, over the limit", title=title)


def draw_quality(panel: Axes, drops: dict[tuple[int, int], dict[float, list[float]]]) -> None:
    for color, ((longest, steps), below) in zip(_plot.CYCLE, drops.items(), strict=False):
        psnr = {b: [-x for x in below[b]] for b in sorted(below)}
        _plot.middles(panel, psnr, marker="o", color=color, label=f"{steps} steps, {longest} px")
        panel.fill_between(
            list(psnr), [min(x) for x in psnr.values()], [max(x) for x in psnr.values()], color=color, alpha=0.1
        )  # fmt: skip
    panel.set_ylim(-8, 0.5)
    title = "trainings (median and range over scenes)"
    _plot.name(panel, y="held-out PSNR below the scene's best, dB", title=title)


def draw_needles(panel: Axes, rows: list[Row]) -> None:
    for color, metric in zip(_plot.CYCLE, distinct(rows, "metric"), strict=False):
        mine = of(rows, metric=metric)
        ratios = [r["ratio_of"] for r in mine]
        panel.plot(
            ratios, [r["condition"] for r in mine], marker="o", color=color, label=f"scaling: {metric}"
        )
    first = of(rows, metric="none")
    if first:
        sizes = [r["largest"] / first[0]["largest"] for r in first]
        label = "largest eigenvalue / that at ratio 1"
        panel.plot([r["ratio_of"] for r in first], sizes, "--", color=_plot.CYCLE[0], label=label)
    _plot.name(panel, "axis ratio", "condition number", "Gauss-Newton block of a needle", log="xy")


FLOATS: dict[str, Any] = {"type": float, "nargs": "+"}
STUDY = Study(
    name="stiffness",
    about=__doc__,
    cases={
        "needles": lambda _: chain.from_iterable(map(needles.measure, needles.RATIOS)),
        "curvature": of_scenes(curvature, CURVATURE_LONGEST),
        "products": of_scenes(products, CURVATURE_LONGEST),
        "runs": of_scenes(runs, LONGEST),
        "groups": of_scenes(groups, LONGEST),
        "recovery": of_scenes(recovery, LONGEST),
    },
    key=(
        "part", "scene", "longest", "steps", "boost", "seed", "group", "by", "share", "sweep", "value", "ratio_of", "metric",
    ),
    blocks={
        "summary": summary,
        "curvature": curvature_table,
        "products": products_table,
        "runs": runs_table,
        "groups": groups_table,
        "warnings": warnings_list,
        "needles": needles_table, "footer": partial(generated, "stiffness")},
    figures={"stiffness": draw},
    options={
        "scenes": {"nargs": "*", "default": SCENES},
        "longest": {"type": int, "help": "longest side of the photos, pixels"},
        "steps": {"type": int, "help": "steps of the trainings"},
        "boosts": FLOATS,
        "seeds": {"type": int, "nargs": "+", "default": [0]},
        "shares": FLOATS | {"default": SHARES},
        "most": {"type": int, "default": MOST, "help": "Gaussians where the Hessian is measured"},
        "work": {"type": Path, "default": CACHE, "help": "folder that keeps recovered cameras"},
    },
)  # fmt: skip
main = STUDY.main

# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""The page and the figure of `bench stiffness`, from rows alone."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from pathlib import Path

import _plot
from _rows import Row, footer
from _train.markdown import section, table
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from splatmill_worker.splat.plan.rates import MOST_BOOST

NAMED_BY = (
    "part",
    "scene",
    "longest",
    "steps",
    "boost",
    "seed",
    "group",
    "by",
    "share",
    "sweep",
    "value",
    "ratio_of",
    "metric",
)
"""Fields that tell rows apart; `ratio_of` is the axis ratio of a needle."""

COLORS = ["#1b6ca8", "#e08e2b", "#2e8b57", "#7a5c1e", "#8e44ad", "#c0392b", "#555555"]


def latest(rows: Iterable[Row]) -> list[Row]:
    """The last row of each measurement, in the order of the first."""
    kept = {json_key(row): row for row in rows}
    return list(kept.values())


def json_key(row: Row) -> tuple[object, ...]:
    return tuple(row.get(name) for name in NAMED_BY)


def middle(values: Iterable[float]) -> float:
    return statistics.median(list(values))


def of(rows: Iterable[Row], **wanted: object) -> list[Row]:
    """The rows whose fields have the given values."""
    return [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]


def distinct(rows: Iterable[Row], name: str) -> list[object]:
    return list(dict.fromkeys(row[name] for row in rows))


def curvature_table(rows: list[Row]) -> str:
    lines = []
    for row in of(rows, part="curvature"):
        alone = " ".join(f"{name} {value:.2g}" for name, value in row["alone"].items())
        lines.append(
            [
                row["scene"], f"{row['boost']:g}", row["step"], row["gaussians"],
                f"{row['ratio']:.2g} ± {row['error']:.1g}", f"{row['beyond']:.0e}", " ".join(f"{x:.2g}" for x in sorted(row["photos"])),
                _lead(row["groups"]), f"{row['stochastic']:.2g}", _lead(row["stochastic_groups"]), f"{row['seen_by']:.1f}",
                f"{row['shared_by']:.1f}", alone, *("-" if row[name] is None else f"{row[name]:.2f}" for name in ("gain", "own")),
            ]
        )  # fmt: skip
    head = "scene|boost|step|Gaussians|eigenvalue / 38|directions beyond 38|of single photos|leading group|in the mean square|leading group|photos that see it|Gaussians in it|each group alone, mean square|gain, mean loss|gain, own photo"
    return table(head, lines) if lines else ""


def _lead(groups: dict[str, float]) -> str:
    """The group with the largest share, and the share."""
    name = max(groups, key=lambda each: groups[each])
    return f"{name} {100 * groups[name]:.0f} %"


def products_table(rows: list[Row]) -> str:
    lines = []
    for row in of(rows, part="products"):
        what = {
            "float64": "float64, differentiated twice",
            "share": "length of the difference, steps",
            "width": "rounding of |r|, grey levels",
        }
        lines.append(
            [
                row["scene"], what[row["sweep"]], f"{row['value']:g}" if "value" in row else "",
                f"{row['largest']:.3f}", f"{row['asymmetry']:.1e}" if "asymmetry" in row else "",
                f"{row['off']:.1e}" if "off" in row else "",
            ]
        )  # fmt: skip
    return table("scene|product|value|eigenvalue / limit|asymmetry|off float64", lines) if lines else ""


def runs_table(rows: list[Row]) -> str:
    """Medians over seeds."""
    lines = []
    plain = of(rows, part="runs", group=None)
    for key in dict.fromkeys((r["scene"], r["longest"], r["steps"], r["boost"]) for r in plain):
        scene, longest, steps, boost = key
        group = of(plain, scene=scene, longest=longest, steps=steps, boost=boost)
        lines.append([scene, longest, steps, f"{boost:g}", len(group), *_outcome(group)])
    head = "scene|pixels|steps|boost|seeds|held-out PSNR dB|training PSNR dB|last loss|Gaussians|axis ratio|larger than the scene|roll-backs|refused values|failed"
    return table(head, lines) if lines else ""


def _outcome(group: list[Row]) -> list[str]:
    done = [row for row in group if "psnr" in row]

    def value(name: str, digits: int) -> str:
        return f"{middle(row[name] for row in done):.{digits}f}" if done else "-"

    failed = [row for row in group if row["outcome"] != "trained"]
    return [
        value("psnr", 2), value("train_psnr", 2), value("loss", 4), value("gaussians", 0), value("axis_ratio", 1),
        f"{100 * middle(row['wide'] for row in done):.2f} %" if done else "-",
        str(sum(row["recoveries"] for row in group)), str(sum(row["refused"] for row in group)), str(len(failed)),
    ]  # fmt: skip


def groups_table(rows: list[Row]) -> str:
    """What changes where one group's rate, or all, are multiplied, against the run with the plan's rates."""
    lines = []
    for row in of(rows, part="runs"):
        if row["group"] is None:
            continue
        base = of(
            rows, part="runs", group=None, scene=row["scene"], longest=row["longest"], steps=row["steps"],
            boost=row["boost"], seed=row["seed"],
        )  # fmt: skip

        def change(name: str, row: Row = row, base: list[Row] = base) -> str:
            return f"{row[name] - base[0][name]:+.2f}" if base and name in row and name in base[0] else "-"

        lines.append(
            [
                row["scene"], row["steps"], row["group"], f"{row['by']:g}", row.get("after", 0), change("psnr"), change("train_psnr"),
                row["recoveries"], row["refused"], "trained" if row["outcome"] == "trained" else "failed",
            ]
        )  # fmt: skip
    head = "scene|steps|group|factor|from step|held-out dB|training dB|roll-backs|refused values|outcome"
    return table(head, lines) if lines else ""


def needles_table(rows: list[Row]) -> str:
    lines = []
    found = of(rows, part="needles")
    for ratio in distinct(found, "ratio_of"):
        cells = [f"{row['largest']:.3g}, {row['condition']:.1e}" for row in of(found, ratio_of=ratio)]
        lines.append([f"{ratio:g}", *cells])
    head = "|".join(["axis ratio", *(f"{name}: largest, condition" for name in distinct(found, "metric"))])
    return table(head, lines) if lines else ""


def warnings_list(rows: list[Row]) -> str:
    """What the user was told, for runs that were rolled back or failed."""
    lines = []
    for row in of(rows, part="runs"):
        if row["warnings"] or row["outcome"] != "trained":
            name = f"{row['scene']}, {row['steps']} steps, boost {row['boost']:g}"
            name += f", {row['group']} times {row['by']:g}" if row["group"] else f", seed {row['seed']}"
            lines.append(f"- {name}: {' / '.join([*row['warnings'], row['outcome']])}")
    return "\n".join(lines) or "None."


def draw(rows: list[Row], path: Path) -> None:
    """Four panels: the eigenvalue over its limit, the same by group, quality, and needles."""
    figure, panels = plt.subplots(2, 2, figsize=(11.5, 8.2))
    _draw_ratio(panels[0][0], of(rows, part="curvature"))
    _draw_groups(panels[0][1], of(rows, part="curvature"))
    _draw_quality(panels[1][0], of(rows, part="runs", group=None))
    _draw_needles(panels[1][1], of(rows, part="needles"))
    _plot.save(figure, path, footer(rows))


def _by_boost(
    rows: list[Row], value: Callable[[Row], float]
) -> tuple[list[float], list[float], list[float], list[float]]:
    boosts = sorted({row["boost"] for row in rows})
    each = [[value(row) for row in rows if row["boost"] == boost] for boost in boosts]
    return boosts, [middle(x) for x in each], [min(x) for x in each], [max(x) for x in each]


def _boost_axis(panel: Axes) -> None:
    panel.set_xscale("log", base=2)
    panel.axvline(MOST_BOOST, color="#888888", lw=1, ls="--")
    panel.set_xlabel("boost of the learning rates (dashed: MOST_BOOST)")


def _legend(panel: Axes) -> None:
    if panel.get_legend_handles_labels()[0]:
        panel.legend(fontsize=7)


def _draw_ratio(panel: Axes, rows: list[Row]) -> None:
    for color, scene in zip(COLORS, distinct(rows, "scene"), strict=False):
        half = [row for row in of(rows, scene=scene) if row["share"] > 0.4]
        boosts, center, _, _ = _by_boost(half, lambda row: row["ratio"])
        panel.plot(boosts, center, marker="o", color=color, label=f"{scene}: mean of the photos / 38")
        boosts, center, _, _ = _by_boost(half, lambda row: row["stochastic"])
        panel.plot(boosts, center, ":", marker=".", color=color, label=f"{scene}: in the mean square")
    panel.axhline(1.0, color=_plot.LOSER)
    panel.set_yscale("log")
    _boost_axis(panel)
    panel.set_ylabel("largest eigenvalue / stability limit")
    panel.set_title("Adam's preconditioned Hessian, half way through a training", fontsize=10)
    _legend(panel)


def _draw_groups(panel: Axes, rows: list[Row]) -> None:
    half = [row for row in rows if row["share"] > 0.4]
    for color, name in zip(
        COLORS, dict.fromkeys(name for row in half for name in row["alone"]), strict=False
    ):
        mine = [
            {"boost": row["boost"], "alone": row["alone"][name]}
            for row in half
            if row["alone"].get(name, 0.0) > 0
        ]
        if mine:
            boosts, center, _, _ = _by_boost(mine, lambda row: row["alone"])
            panel.plot(boosts, center, marker="o", color=color, label=name)
    panel.axhline(1.0, color=_plot.LOSER)
    panel.set_yscale("log")
    _boost_axis(panel)
    panel.set_ylabel("growth in the mean square, over the limit")
    panel.set_title("each group alone, half way (median over scenes)", fontsize=10)
    _legend(panel)


def _draw_quality(panel: Axes, rows: list[Row]) -> None:
    for color, ((longest, steps), below) in zip(COLORS, losses(rows).items(), strict=False):
        boosts = sorted(below)
        panel.plot(
            boosts,
            [-middle(below[b]) for b in boosts],
            marker="o",
            color=color,
            label=f"{steps} steps, {longest} px",
        )
        panel.fill_between(
            boosts, [-max(below[b]) for b in boosts], [-min(below[b]) for b in boosts], color=color, alpha=0.1
        )
    _boost_axis(panel)
    panel.set_ylim(-8, 0.5)
    panel.set_ylabel("held-out PSNR below the scene's best, dB")
    panel.set_title("trainings (median and range over scenes)", fontsize=10)
    _legend(panel)


def _draw_needles(panel: Axes, rows: list[Row]) -> None:
    for color, metric in zip(COLORS, distinct(rows, "metric"), strict=False):
        mine = of(rows, metric=metric)
        panel.plot(
            [r["ratio_of"] for r in mine],
            [r["condition"] for r in mine],
            marker="o",
            color=color,
            label=f"scaling: {metric}",
        )
    first = of(rows, metric="none")
    if first:
        panel.plot(
            [r["ratio_of"] for r in first],
            [r["largest"] / first[0]["largest"] for r in first],
            "--",
            color=COLORS[0],
            label="largest eigenvalue / that at ratio 1",
        )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel("axis ratio")
    panel.set_ylabel("condition number")
    panel.set_title("Gauss-Newton block of a needle", fontsize=10)
    _legend(panel)


def document(rows: list[Row]) -> str:
    """The page."""
    parts = [
        "# Stiffness of the optimisation",
        INTRODUCTION,
        summary(rows),
        OUTCOME,
        "![stiffness](figures/stiffness.png)",
        *section("Largest eigenvalue over the stability limit", _if(CURVATURE, curvature_table(rows))),
        *section("How exact the products are", _if(PRODUCTS, products_table(rows))),
        *section("Trainings at boosts of the rates", _if(RUNS, runs_table(rows))),
        *section(
            "Rates multiplied for one group, or for all in the midst of a training",
            _if(GROUPS, groups_table(rows)),
        ),
        *section("What roll-backs said", warnings_list(rows) if of(rows, part="runs") else ""),
        *section("Gauss-Newton blocks of needles", _if(NEEDLES, needles_table(rows))),
        f"Generated by `splatmill bench stiffness`. {footer(rows)}",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def summary(rows: list[Row]) -> str:
    """The answer in figures: the eigenvalue half way by boost, and what the same boosts cost in quality."""
    half = [row for row in of(rows, part="curvature") if 0.4 < row["share"] < 0.6]
    sentences = []
    if half:
        boosts, center, low, high = _by_boost(half, lambda row: row["ratio"])
        found = ", ".join(
            f"{c:.2g} at {b:g} ({a:.2g} to {d:.2g})"
            for b, c, a, d in zip(boosts, center, low, high, strict=True)
        )
        count = len(distinct(half, "scene"))
        sentences.append(
            f"Half way through a training, the largest eigenvalue over its limit is {found}; median and range over the scenes ({count}), by boost."
        )
    for (longest, steps), below in losses(rows).items():
        found = ", ".join(
            f"{middle(x):.2f} at {b:g} ({min(x):.2f} to {max(x):.2f})" for b, x in sorted(below.items())
        )
        sentences.append(
            f"After {steps} steps at {longest} pixels, the held-out PSNR is below the scene's best by, in dB: {found}."
        )
    return " ".join(sentences)


def losses(rows: list[Row]) -> dict[tuple[int, int], dict[float, list[float]]]:
    """By longest side and steps, and by boost: for each scene, the best boost's median PSNR over seeds less this one's."""
    trained = [row for row in of(rows, part="runs", group=None) if row.get("psnr") is not None]
    found: dict[tuple[int, int], dict[float, list[float]]] = {}
    for longest, steps in dict.fromkeys((row["longest"], row["steps"]) for row in trained):
        mine = of(trained, longest=longest, steps=steps)
        by_boost: dict[float, list[float]] = {}
        for scene in distinct(mine, "scene"):
            of_scene = of(mine, scene=scene)
            medians = {row["boost"]: 0.0 for row in of_scene}
            for boost in medians:
                medians[boost] = middle(row["psnr"] for row in of(of_scene, boost=boost))
            for boost, psnr in medians.items():
                by_boost.setdefault(boost, []).append(max(medians.values()) - psnr)
        found[(longest, steps)] = by_boost
    return found


def _if(text: str, found: str) -> str:
    return f"{text}\n\n{found}" if found else ""


INTRODUCTION = """Training is Adam on the loss 0.8 L1 + 0.2 D-SSIM of one photo a step. Short runs multiply the paper's learning rates by a boost
(`splat/plan/rates.py`), at most by `MOST_BOOST`. This page asks whether that limit is the edge of stability: by the eigenvalues of the
Hessian in Adam's metric, and by trainings at boosts below and beyond it. The plans are those of the product but for the boost; the photos
are small. No figure here is a time."""

OUTCOME = """What came of the expectations (in `stiffness.py`):

1. The gap was larger than expected at 8: the mean loss is a factor of four to twenty-five inside its limit, because the second moments hold
   the differences between photos. From a boost of 1 to one of 8 the eigenvalue grows somewhat faster than the boost, not more slowly, and at 32
   all scenes stand at the limit of 38, where their quality falls: theory and trainings agree on an edge between 16 and 32.
2. Single directions outgrow the limit of the mean square from a boost of 4 to 8 on. Each moves one or two Gaussians, by log-scale or
   rotation, not by opacity. Adam bounds such a move by the rate, so that it is noise of the size of the rate, which falls tenfold towards the end. In trainings too, four times the rate costs most in the log-scales: 1.8 dB on
   fox and 3.5 on lund, while lego gains 0.3; no other group costs more than half a decibel.
   At a tenth of the training the largest eigenvalues, by far above 38, belong to the rotations of Gaussians that are still round: no
   gradient has reached their second moments yet. They cost nothing: `gain` is near 1 up to a boost of 8.
3. The divergence is a loss that rises: no value is refused as not finite, in any run. Where it starts from a good state (all rates times 4, that is a boost of 32, from
   step 300 of 480 on), the roll-back to half the rates catches it, at first after 76 steps, and the result is 0.3 dB short of the undisturbed run. Where the rates
   are too large from the first step on, no failure is named, even at 128: the loss never was low, so that it does not rise to three times its lowest, and
   the training ends with a poor scene. The watch also begins only 100 steps after the last change of resolution: a run of fewer than about 150 steps
   cannot be rolled back at all.
4. Needles came out as expected: flat directions, not stiff ones."""

CURVATURE = """In the coordinates in which a step of Adam is -m, the Hessian's eigenvalues decide: with the exact gradient, a quadratic is stable up to
38 (Cohen et al. 2022). `eigenvalue / 38` is the largest of the mean loss over 8 photos, by Lanczos, with its residual as the error; `directions
beyond 38` the estimated share of all eigenvalues (Ritz weights). With one photo a step, the mean squares of the parameters must not grow
either: the limit is then 2 for a direction that one photo in many curves, 38 for one that all curve alike (`_stiffness/mean_square.py`). `in the
mean square` is 1 over the factor on all rates at which they begin to grow, for the worst of four directions: a lower bound. `photos that see it` and `Gaussians
in it` are participation numbers. `gain` is the fall of the loss in the next step over what its gradient promises, 1 for short steps."""

PRODUCTS = """|r| is replaced by the root of r^2 + d^2, with d one grey level. A product is a central difference of the fused step's float32 gradient, over a
length at which the value that moves most moves by its own rate. `off float64` compares with the float64 reference differentiated twice, on two
photos, for the largest eigenvector; `asymmetry` is the difference of u.Av and v.Au over the norms, for two vectors of curved directions. Differences
over a distance count the renderer's thresholds (alpha 1/255, the end of a pixel) as they are crossed; double differentiation takes
them as constant. Over the length of a step the eigenvalue is that of float64 to half a percent, and the product with its vector to 3 percent; without any
rounding of |r| it is 14 percent larger, and 4 percent or less off at other widths. The largest eigenvalue is known to some ten percent, then, where
the edge is a factor of ten away."""

RUNS = """Medians over seeds. `axis ratio` is the median of the longest over the shortest axis at the end; `larger than the scene` the share of Gaussians with
an axis beyond the radius of the cameras."""

GROUPS = """Against the run with a boost of 8 and the same seed. From the step given on, the rates of the group are multiplied by the factor; a factor of 4 on all
groups is a boost of 32."""

NEEDLES = """Largest eigenvalue of J^T J and condition number (the quaternion's length left out), for a needle 4 pixels long (standard deviation) in five cameras."""

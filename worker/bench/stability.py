# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""`bench stability`: the error of every engine in units of what rounding its inputs already does, along stiff axes.

    splatmill bench stability                       # all axes, the oracle, figures and table: under 10 minutes
    splatmill bench stability --axis beside         # one axis, printed only
    splatmill bench stability --axis beside_tiny --update    # one axis in place of its rows, and what is drawn from them
    splatmill bench stability --plot-only

An error of 1 unit is what any algorithm has that reads float32 (`_stability/conditioning.py`). Expected before the first
run: a flat line near 1 for the fused step, and growth with the axis ratio for all that assembles the conic.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterable

import _plot
import torch
from _rows import HERE, Row, footer, read, write
from _stability.conditioning import Problem, state
from _stability.engines import CHAIN, CONIC, FUSED, GPU, Engine, engines
from _stability.formulas import FORMULAS
from _stability.reasons import HIDDEN, REASONS, UNIT
from _stability.scenes import AXES, GROUPS, Axis
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from torch import Tensor

LIMIT = 4.0
"""Units that an engine which trains should stay within."""

ORACLE_RATIOS = (1.0, 1e3, 1e6)


def measure(problem: Problem, engine: Engine) -> list[Row]:
    """One row for the image, one for each group of gradients and one for the pose."""
    got = engine(problem)
    blank = (problem.exact.image == 0).all(2)
    off = (got.image.double() - problem.exact.image).abs().amax(2)
    counted = ~problem.undecided & ~blank
    image: Row = {"quantity": "image", **figures(off[counted], _image_units(problem, counted))}
    image["undecided"] = int(problem.undecided.sum())
    image["flips"] = int((problem.undecided & (off > 16 * problem.designed.image.amax(2))).sum())
    image["drawn where nothing is"] = int((blank & ~problem.undecided & (off > 0)).sum())
    rows = [image]
    for k in got.gradients:
        want, error = problem.exact.gradients[k], got.gradients[k].double() - problem.exact.gradients[k]
        units = [x.gradients[k] for x in (problem.designed, problem.unit, problem.explained)]
        row: Row = {"quantity": k, **figures(error.abs().flatten(), [u.flatten() for u in units[:2]])}
        row["size"] = float(want.norm())
        if k != "pose":
            each = [_lengths(error) / _lengths(u) for u in units]
            row |= {"gaussian": _worst(each[0]), "gaussian_median": _median(each[0])}
            row |= {"gaussian_inputs": _worst(each[1]), "gaussian_explained": _worst(each[2])}
        rows.append(row)
    return rows


def figures(error: Tensor, units: list[Tensor]) -> Row:
    """Ratios of errors to the units with and without the error of 2^x, and the plain sizes of both."""
    designed, inputs = units
    if not len(error):
        return {"max": 0.0, "p999": 0.0, "median": 0.0, "norm": 0.0, "inputs": 0.0, "error": 0.0, "unit": 0.0}
    ratio = error / designed
    return {
        "max": _worst(ratio),
        "p999": float(ratio.sort().values[math.ceil(0.999 * len(ratio)) - 1]),
        "median": _median(ratio),
        "norm": float(error.norm() / designed.norm()),
        "inputs": _worst(error / inputs),
        "error": float(error.norm()),
        "unit": float(designed.norm()),
    }


def _image_units(problem: Problem, counted: Tensor) -> list[Tensor]:
    return [x.image.amax(2)[counted] for x in (problem.designed, problem.unit)]


def _lengths(x: Tensor) -> Tensor:
    lengths: Tensor = x.reshape(len(x), -1).norm(dim=1)
    return lengths


def _worst(x: Tensor) -> float:
    """The largest value; infinity where one is not a number, so that it cannot hide."""
    return float(torch.nan_to_num(x, nan=math.inf, posinf=math.inf).max()) if len(x) else 0.0


def _median(x: Tensor) -> float:
    return float(x.median()) if len(x) else 0.0


def sweep(axis: Axis, seeds: int, draws: int, running: dict[str, Engine]) -> Iterable[Row]:
    """Rows of one axis: for every value and engine, the worst scene's figures of each quantity."""
    for value in axis.values:
        worst: dict[tuple[str, str], Row] = {}
        for seed in range(1 if axis.dear else seeds):
            problem = state(axis.make(value, seed), draws, seed)
            for name, engine in running.items():
                if name == GPU and not axis.tiny:
                    continue
                for row in measure(problem, engine):
                    key = (name, row["quantity"])
                    if key not in worst or row["max"] > worst[key]["max"]:
                        worst[key] = row
        for (name, _), row in worst.items():
            yield {"bench": "stability", "axis": axis.name, "value": value, "engine": name, **row}


def oracle() -> Iterable[Row]:
    """How far the float64 reference is from 50 digits, in the same units."""
    from _stability.oracle import compare

    for ratio in ORACLE_RATIOS:
        for quantity, worst in compare(ratio).items():
            yield {
                "bench": "stability", "axis": "oracle", "value": ratio, "engine": "reference float64",
                "quantity": quantity, "max": worst,
            }  # fmt: skip


def formulas() -> Iterable[Row]:
    for axis in FORMULAS:
        for value in axis.values:
            for name, (error, used) in axis.errors(value).items():
                yield {
                    "bench": "stability", "axis": f"formula: {axis.name}", "value": value, "engine": name,
                    "quantity": "formula", "error": error, "used": used,
                }  # fmt: skip


def per_gaussian(rows: Iterable[Row], figure: str = "gaussian") -> dict[float, float]:
    """By value of the axis, the worst Gaussian's error over all groups of gradients, in units."""
    found: dict[float, float] = {}
    for row in rows:
        if figure in row:
            found[row["value"]] = max(found.get(row["value"], 0.0), row[figure])
    return found


def draw_axis(panel: Axes, axis: Axis, rows: list[Row], names: list[str]) -> None:
    """The worst Gaussian's gradient error in units, of each engine."""
    for i, name in enumerate(names):
        mine = [r for r in rows if r["axis"] == axis.name and r["engine"] == name]
        for field, style, label in (
            ("gaussian", "-", name),
            ("gaussian_explained", ":", "... with the difference"),
        ):
            if not mine or (field == "gaussian_explained" and name != names[0]):
                continue
            xs, ys = zip(*sorted(per_gaussian(mine, field).items()), strict=True)
            shown = [min(max(y, 1e-1), 1e6) for y in ys]
            panel.plot(
                xs, shown, style, marker="osv^D"[i % 5], markersize=4, color=color(name), label=label, lw=1.5
            )
    panel.axhspan(1e-1, LIMIT, color="#2e8b57", alpha=0.08)
    panel.set_yscale("log")
    if axis.log:
        panel.set_xscale("log")
    panel.set_ylim(1e-1, 1e6)
    panel.set_xlabel(axis.label, fontsize=9)


def color(name: str) -> str:
    if name.startswith(FUSED):
        return _plot.COLORS[f"cpu {name.split(', ')[1]}"]
    return {CHAIN: "#7a5c1e", CONIC: _plot.LOSER}.get(name, _plot.COLORS["gpu"])


def draw(rows: list[Row]) -> None:
    """All axes in one figure, and the two of needles in another."""
    names = engine_names(rows)
    for file, axes, columns in (
        ("stability", AXES, 3),
        ("stability_axis_ratio", [a for a in AXES if a.name in ("axis_ratio", "beside")], 2),
    ):
        lines = -(-len(axes) // columns)
        drawn, panels = plt.subplots(lines, columns, figsize=(5 * columns, 3.2 * lines + 0.5), squeeze=False)
        for panel in panels.flat[len(axes) :]:
            panel.axis("off")
        for axis, panel in zip(axes, panels.flat, strict=False):
            draw_axis(panel, axis, rows, names)
        for line in panels:
            line[0].set_ylabel("worst Gaussian's gradient,\nerror / (condition x roundoff)", fontsize=9)
        panels.flat[0].legend(fontsize=8)
        _plot.save(drawn, HERE / "figures" / f"{file}.png", footer(rows))
    drawn, beside = _plot.axes(len(FORMULAS), width=4.2)
    for formula, panel in zip(FORMULAS, beside, strict=True):
        mine = [r for r in rows if r["axis"] == f"formula: {formula.name}"]
        for name in dict.fromkeys(r["engine"] for r in mine):
            points = [(r["value"], max(r["error"], 1e-9)) for r in mine if r["engine"] == name]
            used = next(r["used"] for r in mine if r["engine"] == name)
            panel.plot(*zip(*points, strict=True), color=_plot.WINNER if used else _plot.LOSER, label=name)
        panel.set_yscale("log")
        if formula.log:
            panel.set_xscale("log")
        panel.set_xlabel(formula.label)
        panel.legend(fontsize=8)
    _plot.save(drawn, HERE / "figures" / "stability_formulas.png", footer(rows))


def engine_names(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(r["engine"] for r in rows if r["axis"] in {a.name for a in AXES}))


def short(x: float) -> str:
    return "0" if x == 0 else f"{x:.1f}" if x < 100 else f"{x:.0e}"


def table(rows: list[Row]) -> str:
    """The report: first what can be checked, then every axis, then where an engine leaves the limit and why."""
    mine = [r for r in rows if r["axis"] in {a.name for a in AXES}]
    names = engine_names(rows)

    def worst(name: str, axes: Iterable[Axis]) -> float:
        return max(
            max(per_gaussian(r for r in mine if r["engine"] == name and r["axis"] == a.name).values())
            for a in axes
        )

    needles = [a for a in AXES if a.name in ("axis_ratio", "beside")]
    fused = [n for n in names if n.startswith(FUSED)]
    head = (
        f"On needles of axis ratio 1 to 1e6, on the image and beside it, the gradient that the fused CPU step gives to the worst"
        f" Gaussian is off by at most {short(max(worst(n, needles) for n in fused))} times what rounding its inputs to float32 "
        f"changes it by; with a conic of three float32 numbers (separate ops) it is {short(worst(CHAIN, needles))} times, and "
        f"with all of the reference in float32 {short(worst(CONIC, needles))} times."
    )
    if GPU in names:
        tiny = [a for a in AXES if a.tiny]
        head += (
            f" On images of 96 x 32 pixels, which Triton's interpreter can do, the GPU's step is off by at most {short(worst(GPU, tiny))} times, "
            f"the CPU's by {short(max(worst(n, tiny) for n in fused))} times and the separate ops by {short(worst(CHAIN, tiny))} times."
        )
    lines = ["# Error against conditioning", "", head, "", UNIT, "",
             f"Limit: {LIMIT:g} units. Columns: the worst pixel; the worst and the median Gaussian over all groups of gradients, by the norm "
             "of its error over the norm of its units; the norm of all Gaussians' errors over that of their units; the worst single "
             "entry; the pose; then the worst Gaussian again, against the rounding of the inputs alone, and with the rounding of the difference explained below. "
             "Each is the worst along the axis, and `over at` lists the values where the worst Gaussian leaves the limit.", "",
             "| axis | engine | pixel | pixel, p99.9 | Gaussian | median | norm | entry | pose | Gaussian, inputs only | Gaussian, with the difference | over at |",
             "|---|---|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for axis in AXES:
        for name in names:
            part = [r for r in mine if (r["axis"], r["engine"]) == (axis.name, name)]
            image = [r for r in part if r["quantity"] == "image"]
            groups = [r for r in part if r["quantity"] in GROUPS]
            if not part:
                continue
            poses = [r["max"] for r in part if r["quantity"] == "pose"]
            over = [f"{v:g}" for v, y in sorted(per_gaussian(part).items()) if y > LIMIT]
            lines.append(
                f"| {axis.label} | {name} | {short(max(r['max'] for r in image))} | {short(max(r['p999'] for r in image))} | "
                f"{short(max(r['gaussian'] for r in groups))} | {short(max(r['gaussian_median'] for r in groups))} | "
                f"{short(max(r['norm'] for r in groups))} | {short(max(r['max'] for r in groups))} | "
                f"{short(max(poses)) if poses else ''} | "
                f"{short(max(r['gaussian_inputs'] for r in groups))} | "
                f"{short(max(r['gaussian_explained'] for r in groups))} | {', '.join(over)} |"
            )
    lines += ["", "## Why a line is not flat", ""]
    lines += [HIDDEN, ""]
    lines += [f"- **{axis.label}.** {REASONS[axis.name]}" for axis in AXES if axis.name in REASONS]
    lines += ["", "## Decisions", "",
              "Pixels whose decision (1/255, 0.999, the end of the list) lies within the reach of rounding have no unit: the image jumps "
              "there. They get no weight in the gradients and are counted here: as undecided, as flipped (wrong by more than 16 "
              "units), and, among all others, as drawn where the exact image has nothing.", "",
              "| axis | undecided | " + " | ".join(f"{n}: flipped" for n in names) + " | "
              + " | ".join(f"{n}: drawn where nothing is" for n in names if n in (CHAIN, CONIC)) + " |",
              "|---" * (2 + len(names) + sum(n in (CHAIN, CONIC) for n in names)) + "|"]  # fmt: skip
    for axis in AXES:
        image = [r for r in mine if r["axis"] == axis.name and r["quantity"] == "image"]

        def total(field: str, name: str, image: list[Row] = image) -> int | str:
            counts = [r[field] for r in image if r["engine"] == name]
            return sum(counts) if counts else ""

        cells = [total("undecided", names[0]), *(total("flips", n) for n in names)]
        cells += [total("drawn where nothing is", n) for n in names if n in (CHAIN, CONIC)]
        lines.append(f"| {axis.label} | " + " | ".join(str(c) for c in cells) + " |")
    lines += ["", "## How exact the definition is", "",
              "Twenty Gaussians in 12 x 12 pixels in 50 decimal digits (mpmath): the worst difference of the float64 reference, in the same "
              "units. What is far below 1 does not show in the figures above.", "",
              "| axis ratio | " + " | ".join(("image", *GROUPS)) + " |", "|---" * (2 + len(GROUPS)) + "|"]  # fmt: skip
    for ratio in ORACLE_RATIOS:
        found = {r["quantity"]: r["max"] for r in rows if r["axis"] == "oracle" and r["value"] == ratio}
        if found:
            lines.append(f"| {ratio:g} | " + " | ".join(f"{found[k]:.0e}" for k in ("image", *GROUPS)) + " |")
    lines += ["", "![All axes](figures/stability.png)", "", "Formulas that the kernels use (black) and that they avoid (red):", "",
              "![Formulas](figures/stability_formulas.png)", "", f"Generated by `splatmill bench stability`. {footer(rows)}", ""]  # fmt: skip
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="bench stability", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2, help="scenes per point, where a scene takes little")
    parser.add_argument("--draws", type=int, default=8, help="changes of the inputs per scene")
    parser.add_argument(
        "--axis", choices=[a.name for a in AXES], action="append", help="only these, no files"
    )
    parser.add_argument(
        "--update",
        action="store_true",
        help="with --axis: replace the rows of these axes, and draw all again",
    )
    parser.add_argument("--plot-only", action="store_true", help="figures and table from the rows there are")
    options = parser.parse_args(argv)
    if not options.plot_only:
        os.environ.setdefault("TRITON_INTERPRET", "1")  # before Triton is imported
        running = engines()
        if GPU not in running:
            print("Triton is not installed: without the GPU's step.")
        rows: list[Row] = []
        for axis in AXES:
            if options.axis and axis.name not in options.axis:
                continue
            for row in sweep(axis, options.seeds, options.draws, running):
                rows.append(row)
                if row["quantity"] in ("image", "means", "log_scales"):
                    print(
                        f"{axis.name:12} {row['value']:<8g} {row['engine']:22} {row['quantity']:10} "
                        f"entry {short(row['max']):8} Gaussian {short(row.get('gaussian', 0.0)):8}",
                        flush=True,
                    )
        if options.axis and not options.update:
            return 0
        if options.axis:
            rows = [*(row for row in read("stability") if row["axis"] not in options.axis), *rows]
        else:
            rows += [*oracle(), *formulas()]
        write("stability", rows)
    rows = read("stability")
    draw(rows)
    (HERE / "stability.md").write_text(table(rows))
    return 0


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))

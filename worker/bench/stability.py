# ruff: noqa: E501  (prose is as long as it is)
"""The error of every engine in units of what rounding its inputs already does, along stiff axes.

    splatmill bench stability                       # all axes, the oracle, figures and table: under 10 minutes
    splatmill bench stability --only beside --dry   # one axis, printed only

An error of 1 unit is what any algorithm has that reads float32 (`_studies/stability/conditioning.py`).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import _plot
import torch
from _page import table
from _rows import Row, distinct, of
from _studies.functions.tolerances import EXP2_ERROR, U
from _studies.stability.conditioning import Problem, state
from _studies.stability.engines import CHAIN, CONIC, FUSED, GPU, Engine, engines
from _studies.stability.formulas import FORMULAS
from _studies.stability.scenes import AXES, GROUPS, Axis
from _studies.study import Study, generated
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

LIMIT = 4.0
"""Units that an engine which trains should stay within."""

ORACLE_RATIOS = (1.0, 1e3, 1e6)
NEEDLES = [axis for axis in AXES if axis.name in ("axis_ratio", "beside")]


def measure(problem: Problem, engine: Engine) -> list[Row]:
    """One row for the image, one for each group of gradients and one for the pose."""
    got = engine(problem)
    blank = (problem.exact.image == 0).all(2)
    off = (got.image.double() - problem.exact.image).abs().amax(2)
    counted = ~problem.undecided & ~blank
    units = [x.image.amax(2)[counted] for x in (problem.designed, problem.unit)]
    image: Row = {"quantity": "image", **figures(off[counted], units)}
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
            row |= {"gaussian": _worst(each[0]), "gaussian_median": float(each[0].median())}
            row |= {"gaussian_inputs": _worst(each[1]), "gaussian_explained": _worst(each[2])}
        rows.append(row)
    return rows


def figures(error: Tensor, units: list[Tensor]) -> Row:
    """Ratios of errors to the units with and without the error of 2^x, and the plain sizes of both."""
    designed, inputs = units
    if not len(error):
        return dict.fromkeys(("max", "p999", "median", "norm", "inputs", "error", "unit"), 0.0)
    ratio = error / designed
    return {
        "max": _worst(ratio),
        "p999": float(ratio.sort().values[math.ceil(0.999 * len(ratio)) - 1]),
        "median": float(ratio.median()),
        "norm": float(error.norm() / designed.norm()),
        "inputs": _worst(error / inputs),
        "error": float(error.norm()),
        "unit": float(designed.norm()),
    }


def _lengths(x: Tensor) -> Tensor:
    lengths: Tensor = x.reshape(len(x), -1).norm(dim=1)
    return lengths


def _worst(x: Tensor) -> float:
    """The largest value; infinity where one is not a number, so that it cannot hide."""
    return float(torch.nan_to_num(x, nan=math.inf, posinf=math.inf).max())


def sweep(axis: Axis, options: argparse.Namespace) -> Iterable[Row | str]:
    """Rows of one axis: for every value and engine, the worst scene's figures of each quantity."""
    os.environ.setdefault("TRITON_INTERPRET", "1")  # before Triton is imported
    running = engines()
    if axis.tiny and GPU not in running:
        print("Triton is not installed: without the GPU's step.", file=sys.stderr)
    for value in axis.values:
        worst: dict[tuple[str, str], Row] = {}
        for seed in range(1 if axis.dear else options.seeds):
            problem = state(axis.make(value, seed), options.draws, seed)
            for name, engine in running.items():
                if name == GPU and not axis.tiny:
                    continue
                for row in measure(problem, engine):
                    key = (name, row["quantity"])
                    if key not in worst or row["max"] > worst[key]["max"]:
                        worst[key] = row
        for (name, _), row in worst.items():
            yield {"bench": "stability", "axis": axis.name, "value": value, "engine": name, **row}


def oracle(_: argparse.Namespace) -> Iterable[Row]:
    """How far the float64 reference is from 50 digits, in the same units."""
    from _studies.stability.oracle import compare

    for ratio in ORACLE_RATIOS:
        for quantity, worst in compare(ratio).items():
            yield {
                "bench": "stability", "axis": "oracle", "value": ratio, "engine": "reference float64",
                "quantity": quantity, "max": worst,
            }  # fmt: skip


def formulas(_: argparse.Namespace) -> Iterable[Row]:
    for axis in FORMULAS:
        for value in axis.values:
            for name, (error, used) in axis.errors(value).items():
                yield {
                    "bench": "stability", "axis": f"formula: {axis.name}", "value": value, "engine": name,
                    "quantity": "formula", "error": error, "used": used,
                }  # fmt: skip


def per_gaussian(rows: Iterable[Row], figure: str = "gaussian") -> dict[float, float]:
    """By value of the axis, the worst Gaussian's error over all groups of gradients, in units."""
    errors: dict[float, float] = {}
    for row in rows:
        if figure in row:
            errors[row["value"]] = max(errors.get(row["value"], 0.0), row[figure])
    return errors


def engine_names(rows: list[Row]) -> list[str]:
    return distinct((r for r in rows if r["axis"] in {a.name for a in AXES}), "engine")


# ---- figures


def draw_axis(panel: Axes, axis: Axis, rows: list[Row], names: list[str]) -> None:
    """The worst Gaussian's gradient error in units, of each engine."""
    for i, name in enumerate(names):
        mine = of(rows, axis=axis.name, engine=name)
        lines = [("gaussian", "-", name), ("gaussian_explained", ":", "... with the difference")]
        for figure, style, label in lines[: 1 + (i == 0)] if mine else []:
            xs, ys = zip(*sorted(per_gaussian(mine, figure).items()), strict=True)
            shown = [min(max(y, 1e-1), 1e6) for y in ys]
            panel.plot(
                xs, shown, style, marker="osv^D"[i % 5], markersize=4, color=color(name), label=label, lw=1.5
            )
    panel.axhspan(1e-1, LIMIT, color="#2e8b57", alpha=0.08)
    _plot.name(panel, axis.label, log="yx" if axis.log else "y", size=9)
    panel.set_ylim(1e-1, 1e6)


def color(name: str) -> str:
    if name.startswith(FUSED):
        return _plot.COLORS[f"cpu {name.split(', ')[1]}"]
    return {CHAIN: "#7a5c1e", CONIC: _plot.LOSER}.get(name, _plot.COLORS["gpu"])


def draw_axes(axes: Sequence[Axis], columns: int, rows: list[Row]) -> Figure:
    lines = -(-len(axes) // columns)
    drawn, panels = _plot.axes(columns, lines, width=5, height=3.2 * lines + 0.5)
    for panel in panels[len(axes) :]:
        panel.axis("off")
    for axis, panel in zip(axes, panels, strict=False):
        draw_axis(panel, axis, rows, engine_names(rows))
    for panel in panels[::columns]:
        _plot.name(panel, y="worst Gaussian's gradient,\nerror / (condition x roundoff)", size=9)
    panels[0].legend(fontsize=8)
    return drawn


def draw_formulas(rows: list[Row]) -> Figure:
    drawn, panels = _plot.axes(len(FORMULAS), width=4.2)
    for formula, panel in zip(FORMULAS, panels, strict=True):
        mine = of(rows, axis=f"formula: {formula.name}")
        for name in distinct(mine, "engine"):
            series = of(mine, engine=name)
            points = [(r["value"], max(r["error"], 1e-9)) for r in series]
            tint = _plot.WINNER if series[0]["used"] else _plot.LOSER
            panel.plot(*zip(*points, strict=True), color=tint, label=name)
        _plot.name(panel, formula.label, log="yx" if formula.log else "y")
        panel.legend(fontsize=8)
    return drawn


# ---- blocks of the page


def short(x: float) -> str:
    return "0" if x == 0 else f"{x:.1f}" if x < 100 else f"{x:.0e}"


def outcome(rows: list[Row]) -> str:
    names = engine_names(rows)
    fused = [n for n in names if n.startswith(FUSED)]

    def worst(engines: list[str], axes: Iterable[Axis]) -> str:
        return short(
            max(max(per_gaussian(of(rows, engine=n, axis=a.name)).values()) for n in engines for a in axes)
        )

    text = (
        f"On needles of axis ratio 1 to 1e6, on the image and beside it, the gradient that the fused CPU step gives to the worst"
        f" Gaussian is off by at most {worst(fused, NEEDLES)} times what rounding its inputs to float32 "
        f"changes it by; with a conic of three float32 numbers (separate ops) it is {worst([CHAIN], NEEDLES)} times, and "
        f"with all of the reference in float32 {worst([CONIC], NEEDLES)} times."
    )
    if GPU in names:
        tiny = [a for a in AXES if a.tiny]
        text += (
            f" On images of 96 x 32 pixels, which Triton's interpreter can do, the GPU's step is off by at most {worst([GPU], tiny)} times, "
            f"the CPU's by {worst(fused, tiny)} times and the separate ops by {worst([CHAIN], tiny)} times."
        )
    return text


def unit(_: list[Row]) -> str:
    return f"""\
**The unit.** Every input (parameters, camera, the image's gradient) is moved at random by the unit roundoff of float32, 2^-24, in the
root mean square; the root mean square change of an output over eight such draws, in float64, is its condition number times
the unit roundoff. To it are added, as squares, the change by an error of {EXP2_ERROR:.1e} of every 2^x, which is what the kernels' polynomial has
by design ({EXP2_ERROR / U:.0f} roundoffs, `functions.md`), and half an ulp of the output. An error of 1 is a backward stable algorithm's; a condition
number that is itself large does not show here, because no algorithm can do better."""


def along_axes(rows: list[Row]) -> str:
    lines = []
    for axis in AXES:
        for name in engine_names(rows):
            part = of(rows, axis=axis.name, engine=name)
            if not part:
                continue
            kinds = {
                "image": of(part, quantity="image"),
                "pose": of(part, quantity="pose"),
                "": [r for r in part if r["quantity"] in GROUPS],
            }
            figures = [
                ("image", "max"), ("image", "p999"), ("", "gaussian"), ("", "gaussian_median"), ("", "norm"), ("", "max"),
                ("pose", "max"), ("", "gaussian_inputs"), ("", "gaussian_explained"),
            ]  # fmt: skip
            cells = [
                short(max(r[figure] for r in kinds[kind])) if kinds[kind] else "" for kind, figure in figures
            ]
            over = [f"{v:g}" for v, y in sorted(per_gaussian(part).items()) if y > LIMIT]
            lines.append([axis.label, name, *cells, ", ".join(over)])
    head = "axis|engine|pixel|pixel, p99.9|Gaussian|median|norm|entry|pose|Gaussian, inputs only|Gaussian, with the difference|over at"
    return table(head, lines)


def decisions(rows: list[Row]) -> str:
    names = engine_names(rows)
    loose = [n for n in names if n in (CHAIN, CONIC)]
    lines = []
    for axis in AXES:
        image = of(rows, axis=axis.name, quantity="image")

        def total(name: str, field: str, image: list[Row] = image) -> int | str:
            mine = of(image, engine=name)
            return sum(r[field] for r in mine) if mine else ""

        cells = [total(names[0], "undecided"), *(total(n, "flips") for n in names)]
        lines.append([axis.label, *cells, *(total(n, "drawn where nothing is") for n in loose)])
    head = ["axis", "undecided", *(f"{n}: flipped" for n in names)]
    return table("|".join([*head, *(f"{n}: drawn where nothing is" for n in loose)]), lines)


def definition(rows: list[Row]) -> str:
    lines = []
    for ratio in ORACLE_RATIOS:
        errors = {r["quantity"]: r["max"] for r in of(rows, axis="oracle", value=ratio)}
        if errors:
            lines.append([f"{ratio:g}", *(f"{errors[k]:.0e}" for k in ("image", *GROUPS))])
    return table("|".join(("axis ratio", "image", *GROUPS)), lines)


CASES: dict[str, Callable[[argparse.Namespace], Iterable[Row | str]]] = {
    **{axis.name: partial(sweep, axis) for axis in AXES},
    "oracle": oracle,
    "formulas": formulas,
}
STUDY = Study(
    name="stability",
    about=__doc__,
    cases=CASES,
    key=("axis", "value", "engine", "quantity"),
    blocks={
        "outcome": outcome,
        "unit": unit,
        "axes": along_axes,
        "decisions": decisions,
        "oracle": definition,
        "footer": partial(generated, "stability"),
    },
    figures={
        "stability": partial(draw_axes, AXES, 3),
        "stability_axis_ratio": partial(draw_axes, NEEDLES, 2),
        "stability_formulas": draw_formulas,
    },
    options={
        "seeds": {"type": int, "default": 2, "help": "scenes per point, where a scene takes little"},
        "draws": {"type": int, "default": 8, "help": "changes of the inputs per scene"},
    },
)
main = STUDY.main

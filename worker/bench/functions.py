# ruff: noqa: E501  (heads of tables and sentences are as long as they are)
"""The error of every elementary function of the CPU kernels, at every float that occurs.

    splatmill bench functions                          # every build that this processor runs: 20 CPU seconds each
    splatmill bench functions --only avx2              # one build; the rows of the others stay
    splatmill bench functions --stride 1021 --dry      # one input in 1021, printed only

The kernels' headers are compiled into a small library for each instruction set, with the kernels' flags, and compared
with float64.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import _plot
from _page import Column, of_rows, table
from _rows import Row, of
from _studies.functions.estimates import ESTIMATE_BOUNDS
from _studies.functions.library import load, measure
from _studies.functions.spans import BINS, FUNCTIONS, Function, place_of, value
from _studies.study import Study, generated
from matplotlib.figure import Figure

from splatmill_worker.kernels.cpu import isa

ORACLE = "float64"
"""What stands in place of a build in the rows of the comparison with 50 digits."""

SAMPLES = 1000
"""Arguments of each function at which the float64 value is compared with 50 decimal digits."""


def of_build(build: str, options: argparse.Namespace) -> Iterator[Row]:
    """Rows of all functions; a build that this processor cannot run has a row that says so, unless it has others."""
    if options.stride > 1 and not options.dry:
        raise SystemExit("The rows are of every float: with --stride, give --dry too.")
    if build in isa.supported():
        yield from (measure(build, function, options.stride) for function in FUNCTIONS)
    elif not of(options.known, build=build):
        yield {"bench": "functions", "function": "", "build": build, "outcome": "not on this processor"}


def oracle(options: argparse.Namespace) -> Iterator[Row]:
    """The float64 values at a sample of arguments and where the largest errors are."""
    for function in FUNCTIONS:
        rows = measured(of(options.known, function=function.name))
        at = [row[f"{figure}_bits"] for row in rows for figure in ("ulp", "relative", "absolute")]
        yield compared(isa.supported()[0], function, at)


def compared(build: str, function: Function, worst: Iterable[int]) -> Row:
    """How far the float64 value is from 50 digits, in ulp of float32: over a sample, and at the floats of some bits."""
    mpmath: Any = importlib.import_module("mpmath")
    library = load(build)
    exact = {
        "exp": mpmath.exp,
        "log2": lambda x: mpmath.log(x, 2),
        "exp2_of_alpha": lambda x: mpmath.mpf(2) ** x,
        "reciprocal": lambda x: 1 / x,
        "reciprocal_sqrt": lambda x: 1 / mpmath.sqrt(x),
        "sqrt": mpmath.sqrt,
    }[function.name]
    places = {place_of(bits) for bits in worst} | {first for first, _ in function.span.parts(SAMPLES)}
    largest = 0.0
    with mpmath.workdps(50):
        for x in map(value, places):
            want = exact(mpmath.mpf(x))
            if want:
                ulp = mpmath.mpf(2) ** (mpmath.frexp(want)[1] - 24)
                largest = max(largest, float(abs(library.exact(function.name.encode(), x) - want) / ulp))
    return {
        "bench": "functions", "function": function.name, "build": ORACLE, "samples": len(places), "ulp": largest,
    }  # fmt: skip


def measured(rows: Iterable[Row]) -> list[Row]:
    """The rows of builds."""
    return [row for row in rows if "arguments" in row]


def draw(rows: list[Row]) -> Figure:
    """The largest error over each part of the arguments, by function and instruction set."""
    figure, panels = _plot.axes(3, 2, width=5, height=7)
    for panel, function in zip(panels, FUNCTIONS, strict=True):
        edges = [value(first) for first, _ in function.span.parts(BINS)] + [function.span.intervals[-1][1]]
        for row in measured(of(rows, function=function.name)):
            color = _plot.COLORS[f"cpu {row['build']}"]
            panel.stairs(row["bins"], edges, baseline=None, label=row["build"], color=color, lw=1.3)
        panel.axhline(0.5, color="#999999", lw=0.8, ls=":")
        panel.set_ylim(0, 1.1 * panel.dataLim.y1)
        _plot.name(panel, title=f"{function.name}: {function.exact}")
        _plot.name(panel, "x", size=9)
        panel.legend(fontsize=8)
    for panel in panels[::3]:
        _plot.name(panel, y="largest error, ulp", size=9)
    return figure


def outcome(rows: list[Row]) -> str:
    most = max(row["ulp"] for row in measured(rows) if row["function"] != "exp2_of_alpha")
    alpha = measured(of(rows, function="exp2_of_alpha"))
    return (
        f"At every float that occurs as an argument, every function of the CPU kernels is within {most:.2f} ulp, "
        f"except the 2^x of compositing, which is a polynomial of degree 4 by choice: its relative error is at most {max(r['relative'] for r in alpha):.2e}, "
        f"or {max(r['ulp'] for r in alpha):.1f} ulp."
    )


def errors(rows: list[Row]) -> str:
    columns: list[Column] = [
        ("function", "`{function}`"), ("arguments", "{arguments}"), ("build", "{build}"), ("counted", "{count:,}"),
        ("octaves compared", lambda row: row.get("octaves", "")), ("unlike", lambda row: row.get("unlike", "")), ("largest, ulp", "{ulp:.3f}"),
        ("at", lambda row: f"{value(place_of(row['ulp_bits'])):.9g}"), ("rms, ulp", "{rms_ulp:.3f}"),
        ("rounded", lambda row: f"{100 * row['rounded']:.1f} %"), ("largest relative", "{relative:.2e}"), ("mean", "{mean_relative:+.1e}"),
        ("largest absolute", "{absolute:.1e}"),
    ]  # fmt: skip
    return of_rows(columns, [r for f in FUNCTIONS for r in measured(of(rows, function=f.name))])


def absent(rows: list[Row]) -> str:
    builds = {row["build"] for row in rows if "outcome" in row} - {row["build"] for row in measured(rows)}
    return (
        f"Not measured, because the processor lacks it: {', '.join(sorted(builds))}. AVX-512 has the operations of AVX2 in wider registers, with the same "
        "results bit for bit, but for the estimates that `reciprocal` and `reciprocal_sqrt` start from."
        if builds
        else ""
    )


def bounds(_: list[Row]) -> str:
    cells = [[f"`{name}`", build, f"{bound:.2f}"] for (name, build), bound in ESTIMATE_BOUNDS.items()]
    return table("function|build|ulp", cells)


def exactness(rows: list[Row]) -> str:
    columns: list[Column] = [
        ("function", "`{function}`"),
        ("arguments", "{samples:,}"),
        ("ulp of float32", "{ulp:.0e}"),
    ]
    return of_rows(columns, [row for row in rows if "samples" in row])


def summary(rows: list[Row]) -> list[str]:
    """The table of docs/programming/precision.md: the largest errors, in ulp, over all arguments that occur."""
    builds = list(dict.fromkeys(row["build"] for row in measured(rows)))
    lines = [
        f"| function | used for | {' | '.join(builds)} | on any processor |",
        "| --- " * (3 + len(builds)) + "|",
    ]
    for function in FUNCTIONS:
        by_build = {row["build"]: row["ulp"] for row in measured(of(rows, function=function.name))}
        documented = [bound for (name, _), bound in ESTIMATE_BOUNDS.items() if name == function.name]
        cells = [*(by_build[build] for build in builds), max([*by_build.values(), *documented])]
        lines.append(
            f"| `{function.name}`: {function.exact} | {function.used_for} | {' | '.join(f'{x:.1f}' for x in cells)} |"
        )
    return lines


STUDY = Study(
    name="functions",
    about=__doc__,
    cases={build: partial(of_build, build) for build in isa.ISAS} | {ORACLE: oracle},
    key=("function", "build"),
    order=lambda row: [*isa.ISAS, ORACLE].index(row["build"]),
    blocks={
        "outcome": outcome,
        "functions": errors,
        "absent": absent,
        "bounds": bounds,
        "oracle": exactness,
        "footer": partial(generated, "functions"),
    },
    figures={"functions": draw},
    options={"stride": {"type": int, "default": 1, "help": "only every so many-th input, for --dry"}},
)
main = STUDY.main

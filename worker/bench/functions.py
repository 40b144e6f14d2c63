# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""`bench functions`: the error of every elementary function of the CPU kernels, at every float that it is meant for.

    splatmill bench functions                  # all inputs: about three CPU minutes for two instruction sets
    splatmill bench functions --stride 1021    # one input in 1021, printed only: seconds
    splatmill bench functions --plot-only

The kernels' headers are compiled into a small library for each instruction set, with the kernels' flags, and compared with
float64. Expected before the first run, from the comments of the headers: exp within 1.2 ulp, log2 and reciprocal within
2, reciprocal_sqrt within 3, sqrt correctly rounded, and a relative error of 2^x below 2.7e-6.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterable
from typing import Any

import _plot
from _functions.estimates import ESTIMATE_BOUNDS
from _functions.library import load, measure
from _functions.spans import FUNCTIONS, Function, Span, place_of, value
from _rows import HERE, Row, footer, read, write
from matplotlib import pyplot as plt

from splatmill_worker.kernels.cpu import isa

SAMPLES = 1000
"""Arguments of each function at which the float64 value is compared with 50 decimal digits."""


def oracle(build: str, function: Function, worst: Iterable[int]) -> Row:
    """How far the float64 value is from 50 digits, in ulp of float32: over a sample, and where the largest errors were found."""
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
    places = {place_of(bits) for bits in worst}
    for span in function.spans:
        places |= {first for first, _ in span.parts(SAMPLES)}
    largest = 0.0
    with mpmath.workdps(50):
        for x in (value(at) for at in places):
            want = exact(mpmath.mpf(x))
            if want:
                ulp = mpmath.mpf(2) ** (mpmath.frexp(want)[1] - 24)
                largest = max(largest, float(abs(library.exact(function.name.encode(), x) - want) / ulp))
    return {
        "bench": "functions", "function": function.name, "build": "float64", "samples": len(places), "ulp": largest,
    }  # fmt: skip


def float_of(bits: int) -> float:
    """The float of these bits."""
    return value(place_of(bits))


def spans() -> Iterable[tuple[Function, Span]]:
    return ((function, span) for function in FUNCTIONS for span in function.spans)


def run(stride: int) -> list[Row]:
    """Rows of all functions and instruction sets; one that this processor lacks has a row that says so."""
    rows: list[Row] = []
    here = isa.supported()
    for build in isa.ISAS:
        if build not in here:
            rows.append(
                {"bench": "functions", "function": "", "build": build, "outcome": "not on this processor"}
            )
            print(f"{build}: not on this processor")
            continue
        for function, span in spans():
            row = measure(build, function, span, stride)
            rows.append(row)
            print(
                f"{build:9} {function.name:16} {span.label:28} {row['count']:>11,} inputs: {row['ulp']:.3f} ulp at "
                f"{float_of(row['ulp_bits']):.9g}, relative {row['relative']:.2e}, absolute {row['absolute']:.2e}",
                flush=True,
            )
    return rows


def draw(rows: list[Row]) -> None:
    """The largest error over each part of the arguments that occur, by function and instruction set."""
    figure, panels = plt.subplots(2, 3, figsize=(15, 7))
    for panel, function in zip(panels.flat, FUNCTIONS, strict=True):
        span = function.spans[-1]
        starts = [value(first) for first, _ in span.parts(len(_drawn(rows, function)[0]["bins"]))]
        for row in _drawn(rows, function):
            ends = [*starts[1:], span.intervals[-1][1]]
            panel.stairs(
                row["bins"], [*starts, ends[-1]], baseline=None, label=row["build"],
                color=_plot.COLORS[f"cpu {row['build']}"], lw=1.3,
            )  # fmt: skip
        panel.axhline(0.5, color="#999999", lw=0.8, ls=":")
        panel.set_ylim(bottom=0)
        panel.set_title(f"{function.name}: {function.exact}", fontsize=10)
        panel.set_xlabel("x", fontsize=9)
        panel.legend(fontsize=8)
    for line in panels:
        line[0].set_ylabel("largest error, ulp", fontsize=9)
    _plot.save(figure, HERE / "figures" / "functions.png", footer(rows))


def _drawn(rows: list[Row], function: Function) -> list[Row]:
    return [row for row in rows if row["function"] == function.name and "bins" in row]


def table(rows: list[Row]) -> str:
    """The report."""
    measured = [row for row in rows if "arguments" in row]
    checked = [row for row in rows if "samples" in row]
    absent = [row["build"] for row in rows if "outcome" in row]
    order = [(function.name, span.label) for function, span in spans()]
    inputs = sum(row["count"] for row in measured)
    most = max(row["ulp"] for row in measured if row["function"] != "exp2_of_alpha")
    alpha = [row for row in measured if row["function"] == "exp2_of_alpha" and "bins" in row]
    lines = [
        "# Errors of the kernels' functions", "",
        f"Over {inputs:,} evaluations, which are all floats of the ranges below, no function of the CPU kernels is off by more than {most:.2f} ulp, "
        f"except 2^x of compositing, which is a polynomial of degree 4 by choice: its relative error is at most {max(r['relative'] for r in alpha):.2e}, "
        f"or {max(r['ulp'] for r in alpha):.1f} ulp.", "",
        "One ulp is the distance of neighbouring floats at the exact value, so 0.5 is the least that a largest error can be. Denormal numbers are "
        "flushed to 0, as in every kernel. `rounded` is the share of results that are the nearest float; `mean` is the mean relative error with its "
        "sign. The arguments are all that the kernels can come to: `exp` holds its own within the limits, alpha is at least 1/255, and so is the "
        "opacity whose logarithm is taken. Nearer to 0 than 2^-30, where e^x and 2^x have the same result for every x, their errors are not counted. "
        "Negative arguments of `reciprocal` do not occur. "
        "`round_small` and `floor` are exact, and sums, products, quotients and `sqrt` are rounded correctly by IEEE 754.", "",
        "| function | arguments | build | inputs | largest, ulp | at | rms, ulp | rounded | largest relative | mean | largest absolute |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *(
            f"| `{r['function']}` | {escaped(r['arguments'])} | {r['build']} | {r['count']:,} | {r['ulp']:.3f} | {float_of(r['ulp_bits']):.9g} | "
            f"{r['rms_ulp']:.3f} | {100 * r['rounded']:.1f} % | {r['relative']:.2e} | {r['mean_relative']:+.1e} | {r['absolute']:.1e} |"
            for r in sorted(measured, key=lambda r: order.index((r["function"], r["arguments"])))
        ), "",
    ]  # fmt: skip
    if absent:
        lines += [
            f"Not measured, because the processor lacks it: {', '.join(absent)}. AVX-512 has the operations of AVX2 in wider registers, with the same "
            "results bit for bit, but for the estimates that `reciprocal` and `reciprocal_sqrt` start from.", "",
        ]  # fmt: skip
    lines += [
        "Estimates differ from one processor to the next. By the error that manufacturers document for them, the results are within:", "",
        "| function | build | ulp |", "|---|---|---|",
        *(f"| `{name}` | {build} | {bound:.2f} |" for (name, build), bound in ESTIMATE_BOUNDS.items()), "",
        "## How exact the comparison is", "",
        "The exact value is the C library's in float64. Its distance from 50 decimal digits (mpmath), at a sample of arguments and at every argument "
        "of a largest error above:", "",
        "| function | arguments | ulp of float32 |", "|---|---|---|",
        *(f"| `{r['function']}` | {r['samples']:,} | {r['ulp']:.0e} |" for r in checked), "",
        "![Largest error against the argument](figures/functions.png)", "",
        f"Generated by `splatmill bench functions`. {footer(rows)}", "",
    ]  # fmt: skip
    return "\n".join(lines)


def escaped(label: str) -> str:
    """A label within a Markdown table."""
    return label.replace("|", "\\|")


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="bench functions", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stride", type=int, help="only every so many-th input, printed and not written")
    parser.add_argument("--plot-only", action="store_true", help="figure and table from the rows there are")
    options = parser.parse_args(argv)
    if options.stride:
        run(options.stride)
        return 0
    if not options.plot_only:
        rows = run(1)
        first = isa.supported()[0]
        for function in FUNCTIONS:
            mine = [row for row in rows if row["function"] == function.name]
            at = [row[f"{figure}_bits"] for row in mine for figure in ("ulp", "relative", "absolute")]
            rows.append(oracle(first, function, at))
        write("functions", rows)
    rows = read("functions")
    draw(rows)
    (HERE / "functions.md").write_text(table(rows))
    return 0


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))

# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""`bench functions`: the error of every elementary function of the CPU kernels, at every float that occurs.

    splatmill bench functions                  # every build that this processor runs: 20 CPU seconds each
    splatmill bench functions --build avx2     # one build; the rows of the others stay
    splatmill bench functions --stride 1021    # one input in 1021, printed only
    splatmill bench functions --plot-only

The kernels' headers are compiled into a small library for each instruction set, with the kernels' flags, and compared with
float64. Expected before the first run, from the comments of the headers: exp within 1.2 ulp, log2 and reciprocal within
2, reciprocal_sqrt within 3, sqrt correctly rounded, and a relative error of 2^x below 2.7e-6.
"""

from __future__ import annotations

import argparse
import importlib
import json
from collections.abc import Iterable, Sequence
from typing import Any

import _plot
from _functions.estimates import ESTIMATE_BOUNDS
from _functions.library import load, measure
from _functions.spans import BINS, FUNCTIONS, Function, place_of, value
from _rows import HERE, Row, footer, origin, read
from matplotlib import pyplot as plt

from splatmill_worker.kernels.cpu import isa

ORACLE = "float64"
"""What stands in place of a build in the rows of the comparison with 50 digits."""

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
    places |= {first for first, _ in function.span.parts(SAMPLES)}
    largest = 0.0
    with mpmath.workdps(50):
        for x in (value(at) for at in places):
            want = exact(mpmath.mpf(x))
            if want:
                ulp = mpmath.mpf(2) ** (mpmath.frexp(want)[1] - 24)
                largest = max(largest, float(abs(library.exact(function.name.encode(), x) - want) / ulp))
    return {
        "bench": "functions", "function": function.name, "build": ORACLE, "samples": len(places), "ulp": largest,
    }  # fmt: skip


def float_of(bits: int) -> float:
    """The float of these bits."""
    return value(place_of(bits))


def run(builds: Sequence[str], stride: int = 1) -> list[Row]:
    """Rows of all functions; a build that this processor cannot run has a row that says so."""
    rows: list[Row] = []
    for build in builds:
        if build not in isa.supported():
            rows.append(
                {"bench": "functions", "function": "", "build": build, "outcome": "not on this processor"}
            )
            print(f"{build}: not on this processor", flush=True)
            continue
        for function in FUNCTIONS:
            row = measure(build, function, stride)
            rows.append(row)
            other = f", {row['unlike']} of the floats in {row['octaves']} differ" if "octaves" in row else ""
            print(
                f"{build:9} {function.name:16} {row['arguments']:16} {row['count']:>11,} inputs: {row['ulp']:.3f} ulp at "
                f"{float_of(row['ulp_bits']):.9g}, relative {row['relative']:.2e}, absolute {row['absolute']:.2e}{other}",
                flush=True,
            )
    return rows


def written(rows: list[Row], name: str = "functions") -> None:
    """Replace the rows of the builds in `rows`, and keep those of others: no processor need run them all."""
    builds = [row["build"] for row in rows if "outcome" not in row]
    path = HERE / "results" / f"{name}.jsonl"
    before = read(name) if path.exists() else []
    known = [row for row in before if row["build"] not in builds]
    known += [{**row, **origin()} for row in rows if row["build"] not in {old["build"] for old in known}]
    order = [*isa.ISAS, ORACLE]
    known.sort(key=lambda row: order.index(row["build"]))
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in known))


def draw(rows: list[Row]) -> None:
    """The largest error over each part of the arguments, by function and instruction set."""
    figure, panels = plt.subplots(2, 3, figsize=(15, 7))
    for panel, function in zip(panels.flat, FUNCTIONS, strict=True):
        edges = [value(first) for first, _ in function.span.parts(BINS)] + [function.span.intervals[-1][1]]
        for row in rows:
            if row["function"] == function.name and "bins" in row:
                panel.stairs(
                    row["bins"], edges, baseline=None, label=row["build"], color=_plot.COLORS[f"cpu {row['build']}"], lw=1.3
                )  # fmt: skip
        panel.axhline(0.5, color="#999999", lw=0.8, ls=":")
        panel.set_ylim(0, 1.1 * panel.dataLim.y1)
        panel.set_title(f"{function.name}: {function.exact}", fontsize=10)
        panel.set_xlabel("x", fontsize=9)
        panel.legend(fontsize=8)
    for line in panels:
        line[0].set_ylabel("largest error, ulp", fontsize=9)
    _plot.save(figure, HERE / "figures" / "functions.png", footer(rows))


def table(rows: list[Row]) -> str:
    """The report."""
    measured = [row for row in rows if "arguments" in row]
    checked = [row for row in rows if "samples" in row]
    absent = [row["build"] for row in rows if "outcome" in row]
    most = max(row["ulp"] for row in measured if row["function"] != "exp2_of_alpha")
    alpha = [row for row in measured if row["function"] == "exp2_of_alpha"]
    lines = [
        "# Errors of the kernels' functions", "",
        f"At every float that occurs as an argument, every function of the CPU kernels is within {most:.2f} ulp, "
        f"except the 2^x of compositing, which is a polynomial of degree 4 by choice: its relative error is at most {max(r['relative'] for r in alpha):.2e}, "
        f"or {max(r['ulp'] for r in alpha):.1f} ulp.", "",
        "One ulp is the distance of neighbouring floats at the exact value, so 0.5 is the least that a largest error can be. Denormal numbers are "
        "flushed to 0, as in every kernel. `rounded` is the share of results that are the nearest float; `mean` is the mean relative error with its "
        "sign.", "",
        "These are all arguments that occur. `exp` holds its own within the limits; alpha is at least 1/255, and so is the opacity whose "
        "logarithm is taken. Nearer to 0 than 2^-30, e^x and 2^x have the same result for every x, and nothing is counted. "
        "For the last three, the errors in [1, 4) are those of all octaves: the results at 4^k x were compared with those at x, and `unlike` of them differ by "
        "more than the power of 2 that they should. "
        "`round_small` and `floor` are exact, and sums, products, quotients and `sqrt` are rounded correctly by IEEE 754.", "",
        "| function | arguments | build | counted | octaves compared | unlike | largest, ulp | at | rms, ulp | rounded | largest relative | mean | largest absolute |",
        "|---" * 13 + "|",
        *(
            f"| `{r['function']}` | {r['arguments']} | {r['build']} | {r['count']:,} | {r.get('octaves', '')} | {r.get('unlike', '')} | {r['ulp']:.3f} | "
            f"{float_of(r['ulp_bits']):.9g} | {r['rms_ulp']:.3f} | {100 * r['rounded']:.1f} % | {r['relative']:.2e} | {r['mean_relative']:+.1e} | "
            f"{r['absolute']:.1e} |"
            for function in FUNCTIONS for r in measured if r["function"] == function.name
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


def summary(rows: list[Row]) -> list[str]:
    """The table of docs/numerics.md: the largest errors, in ulp, over all arguments that occur."""
    builds = [
        build for build in isa.ISAS if any(row["build"] == build and "arguments" in row for row in rows)
    ]
    lines = [
        f"| function | used for | {' | '.join(builds)} | on any processor |",
        "| --- " * (3 + len(builds)) + "|",
    ]
    for function in FUNCTIONS:
        found = {
            row["build"]: row["ulp"]
            for row in rows
            if row["function"] == function.name and "arguments" in row
        }
        documented = [bound for (name, _), bound in ESTIMATE_BOUNDS.items() if name == function.name]
        cells = [*(found[build] for build in builds), max([*found.values(), *documented])]
        lines.append(
            f"| `{function.name}`: {function.exact} | {function.used_for} | {' | '.join(f'{x:.1f}' for x in cells)} |"
        )
    return lines


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="bench functions", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--build", choices=isa.ISAS, action="append", help="only this instruction set")
    parser.add_argument("--stride", type=int, help="only every so many-th input, printed and not written")
    parser.add_argument("--plot-only", action="store_true", help="figure and table from the rows there are")
    options = parser.parse_args(argv)
    builds = options.build or isa.ISAS
    if options.stride:
        run(builds, options.stride)
        return 0
    if not options.plot_only:
        rows = run(builds)
        first = isa.supported()[0]
        for function in FUNCTIONS:
            mine = [row for row in rows if row["function"] == function.name]
            at = [row[f"{figure}_bits"] for row in mine for figure in ("ulp", "relative", "absolute")]
            rows.append(oracle(first, function, at))
        written(rows)
    rows = read("functions")
    draw(rows)
    (HERE / "functions.md").write_text(table(rows))
    return 0


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))

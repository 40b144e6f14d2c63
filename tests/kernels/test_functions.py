"""The elementary functions of the CPU kernels are as exact as worker/bench/functions.md says, on every build.

Not proven here: the arguments between those of the sample. `splatmill bench functions` counts all of them, which takes
minutes. The library that is measured is compiled from the kernels' headers when these tests first run.
"""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
from _rows import read
from _studies.functions import tolerances
from _studies.functions.estimates import ESTIMATE_BOUNDS
from _studies.functions.library import errors, load, measure
from _studies.functions.spans import FUNCTIONS, Function, place, place_of

from splatmill_worker.kernels.cpu import isa
from tests.support.paths import ROOT

STRIDE = 101
"""One argument in so many is tried."""

ROWS = {(row["function"], row["build"]): row for row in read("functions") if "arguments" in row}


def committed(function: Function, build: str) -> dict[str, Any]:
    """The row of the table. AVX-512 has the operations of AVX2."""
    return ROWS.get((function.name, build)) or ROWS[function.name, "avx2"]


@pytest.mark.slow
@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.name)
def test_no_error_is_larger_than_the_table_says(function: Function, build: str) -> None:
    row = committed(function, build)
    sample = measure(build, function, STRIDE)
    figures = ["ulp"]
    if (function.name, build) in ESTIMATE_BOUNDS:
        row = {**row, "ulp": max(row["ulp"], ESTIMATE_BOUNDS[function.name, build])}
    else:
        figures += ["relative", "absolute"]
        # Of the whole and of a sample spread evenly over it: by chance within 1 % for thousands of arguments.
        assert sample["rms_ulp"] <= 1.03 * row["rms_ulp"]
    # The sample may miss the worst arguments, so those of the table are tried with their neighbours.
    library = load(build)
    for figure in figures:
        worst = place_of(row[f"{figure}_bits"])
        around = [
            (max(worst - 20, place(low)), min(worst + 21, place(high) + 1))
            for low, high in function.span.intervals
        ]
        near = errors(library, function.name, around)
        for name, largest in ((figure, getattr(near, figure)), (figure, sample[figure])):
            # The exact value is known to a billionth of an ulp.
            assert largest <= row[figure] * (1 + 1e-8), (
                f"{name}: {largest:.6g}, the table has {row[figure]:.6g}"
            )


@pytest.mark.slow
@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize(("x", "end"), [(-1e30, -87), (-1000, -87), (-87.5, -87), (88.5, 88), (700, 88)])
def test_e_to_the_x_stays_at_the_ends_of_its_range(build: str, x: float, end: float) -> None:
    first = place(x)
    error = errors(load(build), "exp", [(first, first + 1)])
    assert error.absolute == pytest.approx(abs(math.exp(x) - math.exp(end)), rel=1e-6, abs=0)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.name)
def test_the_headers_say_what_was_measured(function: Function) -> None:
    """The comment above each function names a bound, which holds and is not much larger than what is known."""
    text = (ROOT / "worker/splatmill_worker/kernels/cpu/simd" / function.header).read_text()
    comment = re.search(rf"((?://.*\n)+)SPLATMILL_INLINE Float {function.name}\(Float x\)", text)
    if function.name == "sqrt":  # the processor's own
        assert comment is None
        return
    assert comment is not None
    figure, pattern = (
        ("relative", r"relative error below ([\d.e-]+)")
        if function.name == "exp2_of_alpha"
        else ("ulp", r"within ([\d.]+) ulp")
    )
    stated = re.search(pattern, comment[1])
    assert stated is not None
    largest = [row[figure] for (name, _), row in ROWS.items() if name == function.name]
    largest += [bound for (name, _), bound in ESTIMATE_BOUNDS.items() if name == function.name]
    assert max(largest) <= float(stated[1]) < 1.3 * max(largest)


def test_alphas_tolerance_is_the_sum_of_its_parts() -> None:
    assert tolerances.EXP2_ERROR < tolerances.ALPHA_ERROR < 2 * tolerances.EXP2_ERROR

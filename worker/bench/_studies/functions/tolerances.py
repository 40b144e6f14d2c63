"""What the measured errors of functions mean for an alpha: the one source of these figures for benches and proofs.

The errors are the worst of all instruction sets in results/functions.jsonl, which `splatmill bench functions` writes.
"""

from __future__ import annotations

import math

from _rows import Row, read

U = 2.0**-24
"""Unit roundoff of float32."""


def worst(rows: list[Row], function: str, figure: str) -> float:
    """The largest of a figure over the builds that were measured. Raises ValueError where there are none."""
    return max(float(row[figure]) for row in rows if row["function"] == function and "arguments" in row)


_ROWS = read("functions")

EXP_ERROR = worst(_ROWS, "exp", "relative")
"""Relative error of e^x: of every scale, and of e^-logit in the opacity."""

LOG2_ERROR = worst(_ROWS, "log2", "absolute")
"""Absolute error of log2 of an opacity: relative to alpha, ln 2 times that."""

EXP2_ERROR = worst(_ROWS, "exp2_of_alpha", "relative")
"""Relative error of 2^x, from log2 alpha to alpha: a minimax polynomial of degree 4, the largest of all."""

OPACITY_ERROR = EXP_ERROR + 2 * U
"""Relative error of o = 1 / (1 + e^-x): the exponential's times at most 1, a sum and a quotient."""

EXPONENT_ERROR = math.log(2) * (LOG2_ERROR + 6 * 4 * U)
"""Relative error of alpha by that of x = log2 o - u^2 - v^2. Numbers in [4, 8) are rounded by up to 4 U: the record's
`cut` and `level`, and two squares and two differences (two operations in all where they are fused)."""

ALPHA_ERROR = OPACITY_ERROR + EXPONENT_ERROR + EXP2_ERROR
"""Relative error of alpha by functions and sums where u and v are exact."""

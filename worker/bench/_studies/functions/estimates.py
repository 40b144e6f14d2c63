"""How far functions that start from an estimate of the processor can be off, by what is documented of it."""

from __future__ import annotations

ESTIMATE_BOUNDS = {
    # With U = 2^-24. Newton's step squares the estimate's error e: r = (1 + e)/x gives (1 - e^2)/x. Intel and AMD
    # document |e| <= 1.5 2^-12 for rcpps, so e^2 <= 2.25 U, which is up to 2.25 ulp; half an ulp is the last rounding.
    ("reciprocal", "avx2"): 2.25 + 0.5 + 0.01,
    # vrcp14ps: |e| <= 2^-14, e^2 <= 2^-28 = U/16.
    ("reciprocal", "avx512"): 1 / 16 + 0.5 + 0.01,
    # r = (1 + e)/sqrt x gives (1 - 1.5 e^2)/sqrt x: 3.375 U. The rounding of x r, halved, is another U/2.
    ("reciprocal_sqrt", "avx2"): 3.375 + 0.5 + 0.5 + 0.01,
    ("reciprocal_sqrt", "avx512"): 1.5 / 16 + 0.5 + 0.5 + 0.01,
}
"""Largest errors in ulp on any processor, where a function starts from the processor's estimate. The digits of
estimates differ from one processor to the next. The hundredth covers products of two roundings. Without an estimate,
the operations are those of IEEE 754, and the measured error of a build is that of every processor."""

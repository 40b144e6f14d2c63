"""How much of what they allow the proofs use: `python -m tests.support.kernels.slack`.

Prints, over all comparisons, the median of the worst row's error over its allowance, and the comparisons that use most
and least. A median near 0 would say that a regression of that size passes.
"""

from __future__ import annotations

import statistics
import sys

import pytest

from tests.support.kernels import bounds

PROOFS = [
    "tests/kernels/test_proof_forward.py",
    "tests/kernels/test_proof_backward.py",
    "tests/kernels/test_proof_step.py",
]
SHOWN = 5


def main() -> int:
    failed = pytest.main(["-q", "-p", "no:cacheprovider", *PROOFS, *sys.argv[1:]])
    shares = sorted(bounds.measured, key=lambda row: row[1])
    exact = [row for row in shares if row[1] == 0]
    shares = shares[len(exact) :]
    print(
        f"{len(shares)} comparisons (and {len(exact)} that are exact): error / allowed of the worst row of each"
    )
    print(f"median {statistics.median(share for _, share in shares):.3f}")
    for title, rows in (("most", shares[: -SHOWN - 1 : -1]), ("least", shares[:SHOWN])):
        print(title, *(f"  {share:.4f}  {what}" for what, share in rows), sep="\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

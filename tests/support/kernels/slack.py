"""How much of what they allow the proofs use: `python -m tests.support.kernels.slack`.

Prints, over all comparisons, the median of the worst row's error over its allowance, and for every assertion the most
that any case and build uses. Where that is below LEAST, a regression of ten times would pass: LOOSE. Ends with 1 where
a test fails or the median is below MEDIAN.
"""

from __future__ import annotations

import statistics
import sys

import pytest

from tests.support.kernels import bounds

PROOFS = [
    f"tests/kernels/{name}.py"
    for name in (
        "proofs/test_proof_forward",
        "proofs/test_proof_backward",
        "proofs/test_proof_step",
        "cpu/test_cpu_step",
        "cpu/test_cpu_pose",
        "test_loss",
        "test_adam",
        "test_knn",
    )
]
MEDIAN, LEAST = 0.05, 0.1
"""Shares of the allowance."""


def main() -> int:
    failed = pytest.main(["-q", "-p", "no:cacheprovider", *PROOFS, *sys.argv[1:]])
    shares = [row for row in bounds.measured if row[2] > 0]
    exact = len(bounds.measured) - len(shares)
    if not shares:
        print("Nothing was compared.")
        return 1
    median = statistics.median(share for _, _, share in shares)
    worst: dict[str, tuple[float, str]] = {}
    for what, case, share in shares:
        worst[what] = max(worst.get(what, (0.0, "")), (share, case))
    print(f"{len(shares)} comparisons (and {exact} that are exact): error / allowed of the worst row of each")
    print(f"median {median:.3f}")
    print("most of each assertion, and where")
    for what, (share, case) in sorted(worst.items(), key=lambda row: -row[1][0]):
        print(f"  {share:.3f}  {what}: {case}{'  LOOSE' if share < LEAST else ''}")
    return int(bool(failed) or median < MEDIAN)


if __name__ == "__main__":
    sys.exit(main())

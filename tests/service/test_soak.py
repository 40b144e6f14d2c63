"""A short soak: a fault of each main kind against the whole service, which then must have lost nothing.

The jobs are the engine's, on eleven small photos. `make soak` has hundreds of faults. That its checks find what they
look for is proven in tests/server/bench/test_soak_checks.py and test_soak_processes.py. Not proven here: faults of S3,
and that hundreds are survived.
"""

import pytest
import soak

KINDS = (
    "trainer killed",
    "decoder of the trainer killed",
    "worker killed",
    "API killed",
    "everything killed",
    "Redis cut off",
    "disk full",
    "clock set",
)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # the soak has limits of its own, which name what did not end
def test_a_fault_of_each_kind_loses_nothing() -> None:
    *faults, end = soak.soak(s3=False, count=0, seed=1, only=KINDS, patience=5.0)
    assert {row["fault"] for row in faults} | end["left_out"].keys() >= set(KINDS)
    assert end["complaints"] == []
    assert end["succeeded"] + end["cancelled"] == end["jobs"]
    assert end["succeeded"] >= 1  # the number of jobs depends on the speed of the machine

"""Mean distance to the three nearest others: every backend against all pairs in float64, on awkward sets of points.

Says nothing about speed.
"""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops, reference
from tests.support.kernels.bounds import at_most
from tests.support.kernels.proof import EPS, backends, use, where

TINY = 2.0**-126


def _points(kind: str) -> Tensor:
    g = torch.Generator().manual_seed(9)
    base = torch.randn(1500, 3, generator=g)
    return {
        "cloud": base,
        "two": base[:2],
        "three": base[:3],
        "four": base[:4],
        "seventeen": base[:17],
        "all the same": torch.ones(300, 3),
        "duplicates": torch.cat([base[:500], base[:500], base[:10].repeat(30, 1)]),
        "a line": torch.cat([base[:, :1], torch.zeros(1500, 2)], 1),
        "a grid": torch.cartesian_prod(*[torch.arange(10.0)] * 3),
        "two scales": torch.cat([base * 1e-4, base * 1e4]),
        "far from the origin": base + 1e4,
        "one far away": torch.cat([base, torch.tensor([[1e6, 0.0, 0.0]])]),
    }[kind]


KINDS = ["cloud", "two", "three", "four", "seventeen", "all the same", "duplicates", "a line", "a grid", "two scales",
         "far from the origin", "one far away"]  # fmt: skip


@cache
def exact(kind: str) -> Tensor:
    """The definition, once for all backends."""
    return reference.knn(_points(kind).double())


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_the_definitions(kind: str, backend: str) -> None:
    points = _points(kind)
    device = where(backend)
    with use(backend) as op:
        got = ops.knn(points.to(device), backend=op).cpu().double()
    want = exact(kind)
    # A difference of coordinates is rounded once, so is each of six operations more and the mean's three.
    at_most("knn", kind, (got - want).abs(), 16 * EPS * want + TINY)


def test_the_definition_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4], [0, 0, 4]])
    assert reference.knn(points).tolist() == pytest.approx(
        [
            (1 + 2 + 4) / 3,
            (1 + 5**0.5 + 17**0.5) / 3,
            (2 + 5**0.5 + 20**0.5) / 3,
            (0 + 4 + 17**0.5) / 3,
            (0 + 4 + 17**0.5) / 3,
        ]
    )


@pytest.mark.parametrize("backend", [b for b in backends() if str(b).startswith("cpu")])
def test_threads_and_order_do_not_show(backend: str) -> None:
    points = torch.randn(40_000, 3, generator=torch.Generator().manual_seed(10))
    shuffle = torch.randperm(40_000, generator=torch.Generator().manual_seed(11))
    before = torch.get_num_threads()
    distances = []
    try:
        with use(backend) as op:
            for threads in (1, 2):
                torch.set_num_threads(threads)
                distances.append(ops.knn(points, backend=op))
            distances.append(ops.knn(points[shuffle], backend=op)[torch.argsort(shuffle)])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(distances[0], distances[1])
    assert torch.equal(distances[0], distances[2])


@pytest.mark.parametrize("backend", ["reference", *backends()])
def test_no_points_give_no_distances(backend: str) -> None:
    with use(backend) as op:
        assert ops.knn(torch.zeros(0, 3, device=where(op)), backend=op).shape == (0,)


@pytest.mark.parametrize("backend", ["reference", *backends()])
@pytest.mark.parametrize(
    "points",
    [
        torch.zeros(1, 3),
        torch.zeros(5, 2),
        torch.zeros(5, 3, dtype=torch.int64),
        torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0]]),
        torch.tensor([[0.0, 0, 0], [float("inf"), 0, 0]]),
    ],
    ids=["one", "two columns", "integers", "nan", "inf"],
)
def test_bad_points_are_named(points: Tensor, backend: str) -> None:
    with use(backend) as op, pytest.raises((TypeError, ValueError), match=r"^points"):
        ops.knn(points.to(where(op)), backend=op)

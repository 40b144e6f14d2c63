"""One bad number in one slot culls that Gaussian and touches nothing else; extreme but valid Gaussians stay.

What trainers do about bad numbers is their own test; here a render or a gradient meets one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from tests.support.kernels.cases import GROUPS, Case, scene
from tests.support.kernels.proof import Run, backends, run, use

INF, NAN = float("inf"), float("nan")
LARGEST = torch.finfo(torch.float32).max
VICTIM = 7
SLOTS = [
    (k, i)
    for k, n in (("means", 3), ("log_scales", 3), ("quats", 4), ("logit_opacities", 1), ("sh", 48))
    for i in range(n)
]
GROUP_SLOTS = [*((k, 0) for k in GROUPS), ("means", 2), ("sh", 40)]


def slots(backend: str) -> list[tuple[str, int]]:
    """Every slot on the best build of the engine and on a GPU; one or two of every group elsewhere."""
    return SLOTS if backend in (backends()[0], "gpu") else GROUP_SLOTS


def small() -> Case:
    """Gaussians that are all in view, the victim among the nearest."""
    case = scene("poison", 36, width=33, height=30, seed=31)
    means = case.means * 0.4
    means[VICTIM] = torch.tensor([0.1, 0.0, -0.5])
    logits = case.logit_opacities.clone()
    logits[VICTIM] = 1.0
    return replace(case, means=means, logit_opacities=logits)


def without(case: Case) -> Case:
    rows = torch.arange(len(case.means)) != VICTIM
    return replace(case, **{k: getattr(case, k)[rows] for k in GROUPS})


def poisoned(case: Case, group: str, slot: int, value: float) -> Case:
    changed = getattr(case, group).clone()
    changed.view(len(changed), -1)[VICTIM, slot] = value
    return replace(case, **{group: changed})


def weights(case: Case) -> list[Tensor]:
    g = torch.Generator().manual_seed(3)
    return [torch.randn(case.height, case.width, *s, generator=g) for s in ((3,), (), ())]


Clean = tuple[Run, dict[str, Tensor]]


def drawn(case: Case, op: ops.Backend) -> Clean:
    """A scene's images and the gradients of their weighted sum."""
    got = run(case, op)
    return got, got.gradients(*weights(case))


def same_sum(a: Tensor, b: Tensor) -> bool:
    """Whether two gradients are equal: to the bit, or on a card, which sums in an order that varies, to rounding."""
    if a.device.type == "cpu":
        return torch.equal(a, b)
    return torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def assert_gone(bad: Run, without_it: Clean, case: Case, differentiate: bool) -> None:
    clean, want = without_it
    for field in bad.projected:
        assert (field[VICTIM] == 0).all()
    for a, b in ((bad.color, clean.color), (bad.alpha, clean.alpha), (bad.depth, clean.depth)):
        assert torch.equal(a, b)
    if not differentiate:
        return
    rows = torch.arange(len(bad.leaves["means"])) != VICTIM
    got = bad.gradients(*weights(case))
    for k in GROUPS:
        assert same_sum(got[k][rows], want[k]), k
        assert (got[k][VICTIM] == 0).all(), k
    # Summed over blocks of sixteen, in which the others now stand elsewhere: equal but for rounding.
    assert torch.allclose(got["viewmat"], want["viewmat"], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backend", ["reference", *backends()])
@pytest.mark.parametrize("value", [NAN, INF, -INF], ids=str)
def test_a_number_that_is_not_finite_culls_its_gaussian_only(value: float, backend: str) -> None:
    case = small()
    with use(backend) as op:
        clean = drawn(without(case), op)
        assert (run(case, op).projected.extents[VICTIM] > 0).all(), "the victim is in view before"
        for group, slot in slots(backend):
            assert_gone(
                run(poisoned(case, group, slot, value), op), clean, case, (group, slot) in GROUP_SLOTS
            )


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("value", [LARGEST, -LARGEST, 1e-40, -1e-40, 0.0, 1e30, -1e30, 88.8, -104.0], ids=str)
def test_an_extreme_number_stays_in_its_own_ellipse(value: float, backend: str) -> None:
    """Culled, or drawn: then everything is finite, and pixels outside its box are untouched."""
    case = small()
    with use(backend) as op:
        clean = drawn(without(case), op)
        for group, slot in slots(backend):
            bad = run(poisoned(case, group, slot, value), op)
            if not (bad.projected.extents[VICTIM] > 0).any():
                assert_gone(bad, clean, case, (group, slot) in GROUP_SLOTS)
                continue
            for field in bad.projected:
                assert torch.isfinite(field).all()
            (x, y), (ex, ey) = bad.projected.means2d[VICTIM].tolist(), bad.projected.extents[VICTIM].tolist()
            ys, xs = torch.arange(case.height) + 0.5, torch.arange(case.width) + 0.5
            outside = ((ys - y).abs() > ey + 0.01)[:, None] | ((xs - x).abs() > ex + 0.01)[None]
            assert torch.equal(bad.alpha[outside], clean[0].alpha[outside])
            assert torch.equal(bad.color[outside], clean[0].color[outside])


@pytest.mark.parametrize("backend", backends())
def test_thresholds_are_culled_on_the_stated_side(backend: str) -> None:
    """z = near is culled and the next float is not; opacity 1/255 is culled and a little more is not."""
    case = scene("thresholds", 4, width=20, height=20)
    viewmat, K = torch.eye(4), torch.tensor([[16.0, 0, 10], [0, 16.0, 10], [0, 0, 1]])
    near = torch.tensor(0.01)
    means = torch.zeros(4, 3)
    means[:, 2] = torch.stack(
        [near, torch.nextafter(near, torch.tensor(1.0)), torch.tensor(2.0), torch.tensor(2.0)]
    )
    edge = math.log((1 / 255) / (1 - 1 / 255))
    case = replace(
        case, means=means, viewmat=viewmat, K=K, log_scales=torch.full((4, 3), -6.0),
        logit_opacities=torch.tensor([0.0, 0.0, edge - 1e-5, edge + 1e-5]),
    )  # fmt: skip
    with use(backend) as op:
        visible = (run(case, op).projected.extents > 0).all(1)
    assert visible.tolist() == [False, True, False, True]


EXTREMES: dict[str, dict[str, object]] = {
    "needle of 1e6": {"log_scales": [math.log(1.0), math.log(1e-6), math.log(1e-6)]},
    "disc of 1e6": {"log_scales": [math.log(1.0), math.log(1.0), math.log(1e-6)]},
    "a point": {"log_scales": [-80.0, -80.0, -80.0]},
    "larger than the scene": {"log_scales": [8.0, 8.0, 8.0]},
    "opacity 1": {"logit_opacities": 80.0},
    "quaternion of norm 1e-30": {"quats": [1e-30, 2e-30, -1e-30, 0.5e-30]},
    "quaternion of norm 1e30": {"quats": [1e30, 2e30, -1e30, 0.5e30]},
    "colour of 1e6": {"sh": 1e6},
}


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_but_valid_stays_visible(name: str, backend: str) -> None:
    case = small()
    for group, value in EXTREMES[name].items():
        changed = getattr(case, group).clone()
        changed[VICTIM] = torch.as_tensor(value)
        case = replace(case, **{group: changed})
    with use(backend) as op:
        got = run(case, op)
        gradients = got.gradients(*weights(case))
    assert (got.projected.extents[VICTIM] > 0).all()
    assert torch.isfinite(got.color).all()
    for k, g in gradients.items():
        assert torch.isfinite(g).all(), k
    if name.startswith("quaternion"):
        scaled = replace(case, quats=case.quats.clone())
        scaled.quats[VICTIM] = torch.tensor([1.0, 2.0, -1.0, 0.5])
        with use(backend) as op:
            same = run(scaled, op)
        # Division by a power of ten rounds each component once.
        assert torch.allclose(got.color, same.color, atol=2e-6)

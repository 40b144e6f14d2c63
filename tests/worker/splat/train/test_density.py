"""Proves what densification does to Gaussians and moments, one event at a time.

Does not prove that it helps: the ablation table of `bench train` measures that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.train.density import prune
from splatmill_worker.splat.train.density.densify import Change, densify, halves, scaled


def gaussians(n: int, scale: float = 0.05, opacity: float = 0.5) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        torch.randn(n, 3, generator=generator),
        torch.full((n, 3), math.log(scale)),
        torch.randn(n, 4, generator=generator),
        torch.full((n,), math.log(opacity / (1 - opacity))),
        torch.randn(n, 16, 3, generator=generator),
    )


@dataclass
class Held:
    """The state of an engine without its kernels: densification touches nothing else."""

    held: Gaussians
    plain: Tensor
    exp_avg: Tensor = field(init=False)
    exp_avg_sq: Tensor = field(init=False)

    def __post_init__(self) -> None:
        n = self.held.count
        self.exp_avg = torch.arange(n)[:, None].expand(n, 59).float().clone()
        self.exp_avg_sq = self.exp_avg.clone()
        self.visible_count = torch.ones(n)
        self.max_extent = torch.zeros(n)

    @property
    def count(self) -> int:
        return self.held.count

    @property
    def plain_sum(self) -> Tensor:
        return self.plain

    def parameters(self) -> dict[str, Tensor]:
        return {name: value.clone() for name, value in self.held.parameters().items()}

    def moments(self) -> tuple[Tensor, Tensor]:
        return self.exp_avg.clone(), self.exp_avg_sq.clone()

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        self.held = Gaussians(**parameters)
        assert exp_avg is not None
        assert exp_avg_sq is not None
        self.exp_avg, self.exp_avg_sq = exp_avg, exp_avg_sq


def split(engine: Held, allowed: int = 1000) -> Change:
    return densify(engine, allowed=allowed)  # type: ignore[arg-type]  # a stand-in with what densify reads


def test_a_split_gaussian_gives_way_to_two_and_the_others_keep_their_moments() -> None:
    before = gaussians(6)
    engine = Held(before, torch.tensor([0.0, 1e-3, 0.0, 0.0, 3e-4, 1e-4]))
    change = split(engine)
    assert change == Change(added=2, removed=0, unsplit=0)
    assert engine.count == 8
    assert torch.equal(engine.held.means[:4], before.means[[0, 2, 3, 5]])
    assert engine.exp_avg[:4, 0].tolist() == [0.0, 2.0, 3.0, 5.0]
    assert torch.equal(engine.exp_avg[4:], torch.zeros(4, 59))
    assert torch.equal(engine.exp_avg_sq[4:], torch.zeros(4, 59))


def test_halves_lie_side_by_side_on_the_longest_axis() -> None:
    """Of a Gaussian that is longest along its own y, which a quarter turn about z makes the world's -x."""
    whole = gaussians(1)
    whole.quats[0] = torch.tensor([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)])
    whole.log_scales[0] = torch.tensor([0.1, 0.4, 0.2]).log()
    two = halves(whole)
    apart = two.means - whole.means
    assert apart[0].tolist() == pytest.approx([-0.4, 0.0, 0.0], abs=1e-6)
    assert torch.allclose(apart[1], -apart[0], atol=1e-6)
    assert torch.allclose(two.log_scales.exp(), torch.tensor([0.085, 0.2, 0.17]).expand(2, 3))
    assert torch.allclose(torch.sigmoid(two.logit_opacities), torch.tensor(0.3))
    assert torch.equal(two.sh, whole.sh.expand(2, -1, -1))
    assert torch.equal(two.quats, whole.quats.expand(2, -1))


def test_halves_of_a_ball_of_nothing_and_of_many_are_defined() -> None:
    """Equal axes: one of them is taken. None: there are no halves. An opacity of 1: the halves are not opaque."""
    assert torch.isfinite(halves(gaussians(5)).means).all()
    assert halves(gaussians(0)).count == 0
    opaque = gaussians(3)
    opaque.logit_opacities[:] = 50.0
    assert torch.allclose(torch.sigmoid(halves(opaque).logit_opacities), torch.tensor(0.6))


def test_halves_come_first_halves_first() -> None:
    three = gaussians(3)
    two = halves(three)
    assert torch.allclose((two.means[:3] + two.means[3:]) / 2, three.means, atol=1e-6)


def test_the_budget_takes_the_largest_scores() -> None:
    before = gaussians(8)
    engine = Held(before, torch.arange(8) * 1e-3)
    assert split(engine, allowed=10) == Change(added=2, removed=0, unsplit=5)
    assert engine.count == 10
    assert torch.equal(engine.held.means[:6], before.means[:6])


def test_what_cannot_be_seen_goes() -> None:
    scene = gaussians(6)
    scene.logit_opacities[0] = -9.0
    scene.means[1, 0] = math.nan
    scene.quats[2] = 0.0
    extent = torch.tensor([0.0, 0.0, 0.0, 9.0, 0.0, math.nan])
    assert prune.keep(scene, extent).tolist() == [False, False, False, False, True, False]
    assert prune.keep(scene, None).tolist() == [False, False, False, True, True, True]


def test_decayed_opacities_are_multiplied() -> None:
    logits = torch.tensor([-2.0, 0.0, 3.0])
    assert torch.allclose(torch.sigmoid(scaled(logits, 0.9)), 0.9 * torch.sigmoid(logits), atol=1e-6)


def test_what_is_far_keeps_its_opacity() -> None:
    engine = Held(gaussians(4), torch.zeros(4))
    engine.held.means[:] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 9.0, 0.0], [2.0, 2.0, 0.0], [-8.0, 0.0, 0.0]])
    densify(engine, allowed=4, opacity_decay=0.9, decay_within=5.0)  # type: ignore[arg-type]  # a stand-in with what densify reads
    assert torch.sigmoid(engine.held.logit_opacities).tolist() == pytest.approx([0.45, 0.5, 0.45, 0.5])


def test_quaternions_become_rotations() -> None:
    turn = rotation(torch.randn(50, 4, generator=torch.Generator().manual_seed(3)).double())
    identity = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    assert torch.allclose(turn @ turn.transpose(1, 2), identity, atol=1e-12)
    assert torch.allclose(torch.linalg.det(turn), torch.ones(50, dtype=torch.float64))
    quarter = rotation(torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]]))
    assert torch.allclose(
        quarter[0] @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6
    )

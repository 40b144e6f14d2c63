"""The GPU training step agrees with the reference's ops in float64, over steps that miss Gaussians.

Also the room of its lists, which follows what a view used. Runs in Triton's interpreter where there is no GPU. Does not
prove the recovery from a real allocation failure. That no step waits for the device is in test_gpu_waiting.
"""

from __future__ import annotations

import math
from dataclasses import astuple, replace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)

from splatmill_worker.kernels import reference
from splatmill_worker.kernels.gpu import bin as gpu_bin
from splatmill_worker.kernels.gpu.record import pack
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import GROUPS, Case, scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
WIDTH, HEIGHT = 20, 12


RATES = Rates(
    means=1e-3, log_scales=5e-3, quats=1e-3, logit_opacities=5e-2, sh_dc=2.5e-3, sh_rest=1e-4, beta2=0.99
)
SIX = astuple(RATES)[:6]


@pytest.fixture
def case() -> Case:
    return scene("small", 10, width=WIDTH, height=HEIGHT, seed=31)


def away(viewmat: Tensor) -> Tensor:
    """A camera that misses some of the Gaussians."""
    moved = viewmat.clone()
    moved[0, 3] += 2.6
    return moved


def photos() -> list[Tensor]:
    g = torch.Generator().manual_seed(4)
    return [torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8) for _ in range(2)]


def engine(case: Case, **more: Any) -> Step:
    return Step(*case.groups(), where=DEVICE, **more)


class Exact:
    """The same steps with the reference's ops and dense Adam, in float64."""

    def __init__(self, case: Case) -> None:
        self.case = case
        means, log_scales, quats, logits, sh = case.groups(torch.float64)
        self.params = [means, log_scales, quats, logits, sh[:, :1].contiguous(), sh[:, 1:].contiguous()]
        self.exp_avg = [torch.zeros_like(p) for p in self.params]
        self.exp_avg_sq = [torch.zeros_like(p) for p in self.params]
        self.last = torch.zeros(len(means), dtype=torch.int32)
        self.plain = torch.zeros(len(means), dtype=torch.float64)

    def train(self, viewmat: Tensor, photo: Tensor, step: int, mask: Tensor | None) -> tuple[float, int]:
        leaves = [p.clone().requires_grad_() for p in self.params]
        fields = self.case.project([*leaves[:4], torch.cat(leaves[4:], 1)], viewmat.double(), "reference")
        fields.means2d.retain_grad()
        bins = reference.bin(fields, WIDTH, HEIGHT)
        color, _, _ = reference.composite(
            fields, bins, WIDTH, HEIGHT, background=self.case.background.double()
        )
        loss = reference.loss(color, photo, mask=mask)
        loss.backward()
        visible = fields.extents[:, 0] > 0
        assert fields.means2d.grad is not None
        self.plain += torch.linalg.vector_norm(
            fields.means2d.grad * torch.tensor([WIDTH / 2, HEIGHT / 2]), dim=1
        )
        reference.adam_(
            self.params, [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves], self.exp_avg,
            self.exp_avg_sq, SIX, step=step, visible=visible, last_step=self.last, beta2=RATES.beta2,
        )  # fmt: skip
        return loss.item(), int(visible.sum())

    def settle(self, step: int) -> None:
        everyone = torch.ones_like(self.last, dtype=torch.bool)
        reference.catch_up_(
            self.params,
            self.exp_avg,
            self.exp_avg_sq,
            SIX,
            step=step,
            rows=everyone,
            last_step=self.last,
            beta2=RATES.beta2,
        )


def test_steps_agree_with_the_definition(case: Case) -> None:
    """Five steps over two views, the last of which misses Gaussians: parameters, moments, losses and scores."""
    here, exact, pictures = engine(case), Exact(case), photos()
    views = [case.viewmat, away(case.viewmat)]
    mask = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) < 0.8
    shown = set()
    for step, number in enumerate((0, 1, 1, 0, 1), 1):
        used = mask if number else None
        loss, visible = exact.train(views[number], pictures[number], step, used)
        result = here.train(
            views[number], case.K, pictures[number],
            degree=3, rates=RATES, step=step, background=case.background, mask=used,
        )  # fmt: skip
        shown.add(visible)
        if DEVICE == "cpu":  # on a device the numbers may be of an earlier step
            assert result.loss == pytest.approx(loss, abs=1e-6)
            assert (result.visible, result.refused) == (visible, 0)
    assert len(shown) == 2, "both views show the same Gaussians, so nothing was caught up"
    exact.settle(5)
    parts = [*exact.params[:4], torch.cat(exact.params[4:], 1)]
    for name, truth in zip(GROUPS, parts, strict=True):
        # Adam's step is the rate times a ratio of moments: relative errors of 1e-4 in a gradient stay that
        # small in it.
        error = (here.parameters()[name].cpu() - truth).abs().max().item()
        assert error <= 2e-6, f"{name}: {error}"
    first, second = (
        torch.cat([m.reshape(10, -1) for m in ms], 1) for ms in (exact.exp_avg, exact.exp_avg_sq)
    )
    for seen_moment, truth in zip(here.moments(), (first, second), strict=True):
        assert (seen_moment.cpu() - truth).abs().max() <= 1e-4 * truth.abs().max()
    assert (here.plain_sum.cpu() - exact.plain).abs().max() <= 1e-4 * exact.plain.max()


def test_scores_that_nobody_asks_for_are_not_kept_and_change_nothing(case: Case) -> None:
    scored, bare = engine(case), engine(case)
    bare.keep_scores = False
    for step in (scored, bare):
        step.train(case.viewmat, case.K, photos()[0], degree=3, rates=RATES, step=1)
    assert scored.plain_sum.max() > 0
    for score in (bare.plain_sum, bare.visible_count, bare.max_extent):
        assert torch.count_nonzero(score) == 0
    for name, value in scored.parameters().items():
        assert torch.allclose(value, bare.parameters()[name], atol=1e-6), name


def test_forward_and_backward_update_do_what_train_does(case: Case) -> None:
    together, apart = engine(case), engine(case)
    photo = photos()[0]
    together.train(case.viewmat, case.K, photo, degree=2, rates=RATES, step=1, dssim_weight=0.2)
    color, alpha, _ = apart.forward(case.viewmat, case.K, WIDTH, HEIGHT, degree=2)
    assert bool((alpha > 0).any())
    color = color.clone().requires_grad_()
    reference.loss(color, photo.to(color.device)).backward()
    assert color.grad is not None
    apart.backward_update(color.grad, rates=RATES, step=1)
    for name, value in together.parameters().items():
        assert torch.allclose(value, apart.parameters()[name], atol=1e-5), name
    with pytest.raises(RuntimeError, match="needs a forward pass"):
        apart.backward_update(color.grad, rates=RATES, step=2)


def test_replace_takes_moments_and_clears_scores(case: Case) -> None:
    here = engine(case)
    here.train(case.viewmat, case.K, photos()[0], degree=3, rates=RATES, step=1)
    parameters, moments = here.parameters(), here.moments()
    assert here.visible_count.any()
    rows = torch.tensor([0, 2, 3, 7])
    here.replace({k: v[rows] for k, v in parameters.items()}, *(m[rows] for m in moments))
    assert here.count == 4
    assert not here.visible_count.any()
    for name, value in here.parameters().items():
        assert torch.equal(value, parameters[name][rows]), name
    assert torch.equal(here.moments()[1], moments[1][rows])
    here.replace({**here.parameters(), "sh": here.parameters()["sh"][:, :4]}, None, None)
    assert here.parameters()["sh"].shape == (4, 16, 3)
    assert not here.moments()[0].any()


def test_a_resumed_training_has_missed_nothing(case: Case) -> None:
    views = [case.viewmat, away(case.viewmat), case.viewmat]
    going = engine(case)
    for step, (view, photo) in enumerate(zip(views[:2], photos(), strict=True), 501):
        going.train(view, case.K, photo, degree=3, rates=RATES, step=step)
    resumed = engine(case)
    resumed.replace(going.parameters(), *going.moments())
    for here in (going, resumed):
        here.train(views[2], case.K, photos()[0], degree=3, rates=RATES, step=503)
    states = [[*here.parameters().values(), *here.moments()] for here in (going, resumed)]
    for one, other in zip(*states, strict=True):
        # Bit by bit, but on a device, whose atomics add in any order.
        assert (
            torch.equal(one, other) if DEVICE == "cpu" else torch.allclose(one, other, rtol=1e-3, atol=5e-3)
        )


def test_what_does_not_fit_is_the_farthest_and_is_counted(case: Case) -> None:
    fields = case.project([group.to(DEVICE) for group in case.groups()], case.viewmat.to(DEVICE), "gpu")
    records = pack(fields)
    whole = gpu_bin.lists(records, WIDTH, HEIGHT, None)
    total = int(whole.bins.offsets[-1])
    cut = gpu_bin.lists(records, WIDTH, HEIGHT, gpu_bin.Room(visible=10, pairs=total - 3))
    assert cut.used.tolist() == whole.used.tolist(), (
        "the true sizes are told, so that the next visit has room"
    )
    kept = int(cut.bins.offsets[-1])
    assert kept == total - 3
    depth = fields.depths[whole.bins.ids.long()]
    nearest = torch.sort(depth).values[:kept]
    assert torch.equal(torch.sort(fields.depths[cut.bins.ids[:kept].long()]).values, nearest)
    roomy = gpu_bin.lists(records, WIDTH, HEIGHT, gpu_bin.Room(visible=40, pairs=total + 50))
    assert torch.equal(roomy.bins.offsets, whole.bins.offsets)
    assert torch.equal(roomy.bins.ids[:total], whole.bins.ids)


def test_room_follows_the_view_and_an_overflow_is_counted(case: Case) -> None:
    here, photo = engine(case), photos()[0]
    more: dict[str, Any] = {"degree": 0, "rates": RATES}
    here.train(case.viewmat, case.K, photo, step=1, **more)
    (key,) = here._rooms
    assert here._rooms[key].pairs >= gpu_bin_pairs(here)
    here._rooms[key] = gpu_bin.Room(visible=10, pairs=2)
    here.train(case.viewmat, case.K, photo, step=2, **more)
    if DEVICE == "cuda":
        torch.cuda.synchronize()
        here.train(case.viewmat, case.K, photo, step=3, **more)
    assert here.overflowed == 1
    assert here._rooms[key].pairs >= gpu_bin_pairs(here)


def gpu_bin_pairs(step: Step) -> int:
    return step._readback.latest.pairs


def test_a_gradient_that_is_not_finite_is_refused_and_counted(case: Case) -> None:
    logits = case.logit_opacities.clone()
    logits[:] = 3.0
    here = engine(replace(case, logit_opacities=logits))
    before = here.parameters()
    color, _, _ = here.forward(case.viewmat, case.K, WIDTH, HEIGHT, degree=0)
    d_color = torch.full_like(color, math.nan)
    here.backward_update(d_color, rates=RATES, step=1)
    if DEVICE == "cuda":
        torch.cuda.synchronize()
        here.forward(case.viewmat, case.K, WIDTH, HEIGHT, degree=0)
        here.backward_update(torch.zeros_like(color), rates=RATES, step=2)
    assert here.refused > 0
    for name, value in here.parameters().items():
        assert torch.isfinite(value).all(), name
    if DEVICE == "cpu":
        assert torch.equal(here.parameters()["means"], before["means"])

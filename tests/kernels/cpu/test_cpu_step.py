"""The fused CPU step is gradients and Adam in one: the update, scores, state, the same bytes on all threads.

Not proven here: the gradients themselves (test_proof_step), convergence of training, speed.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import engine
from splatmill_worker.kernels.cpu.loss import photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
from splatmill_worker.kernels.reference import adam_ as reference_adam_
from tests.support.kernels.cases import GROUPS, Case, scene

RATES = Rates(means=1e-3, log_scales=5e-3, quats=1e-3, logit_opacities=5e-2, sh_dc=2.5e-3, sh_rest=1.25e-4)


def make_step(case: Case, threads: int = 2) -> Step:
    return Step(*case.groups(), threads=threads)


def photo_of(case: Case, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (case.height, case.width, 3), generator=g, dtype=torch.uint8)


def slopes(case: Case) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(5)
    h, w = case.height, case.width
    return (
        torch.randn(h, w, 3, generator=g),
        torch.randn(h, w, generator=g),
        torch.randn(h, w, generator=g),
    )


def differentiate(case: Case, backend: ops.Backend, dtype: torch.dtype) -> tuple[dict[str, Tensor], Tensor]:
    """Gradients of the separate ops to the parameters and to the 2-D means, for the slopes above."""
    groups = [g.requires_grad_() for g in case.groups(dtype)]
    projected = case.project(groups, case.viewmat.to(dtype), backend)
    projected.means2d.retain_grad()
    bins = ops.bin(projected, case.width, case.height, backend=backend)
    image = ops.composite(
        projected, bins, case.width, case.height, background=case.background.to(dtype), backend=backend
    )
    torch.autograd.backward(image, [s.to(dtype) for s in slopes(case)])
    assert projected.means2d.grad is not None
    return {
        n: g.grad for n, g in zip(GROUPS, groups, strict=True) if g.grad is not None
    }, projected.means2d.grad


def fused_gradients(case: Case, step: Step) -> dict[str, Tensor]:
    step.forward(
        *case.camera(),
        case.width,
        case.height,
        degree=case.degree,
        background=case.background,
        antialias=case.antialias,
    )
    return step.gradients(*slopes(case))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_coefficients_beyond_the_degree_have_no_gradient(degree: int) -> None:
    case = replace(scene("step", 150), degree=degree)
    gradient = fused_gradients(case, make_step(case))["sh"]
    unused = (degree + 1) ** 2
    assert torch.count_nonzero(gradient[:, unused:]) == 0
    assert torch.count_nonzero(gradient[:, unused - 1]) > 0


def test_one_step_is_loss_gradient_and_adam() -> None:
    case = scene("train", 120)
    photo, step = photo_of(case), make_step(case)
    groups = [g.requires_grad_() for g in case.groups(torch.float64)]
    projected = case.project(groups, case.viewmat.double(), "reference")
    bins = ops.bin(projected, case.width, case.height, backend="reference")
    color, _, _ = ops.composite(
        projected, bins, case.width, case.height, background=case.background.double(), backend="reference"
    )
    value = ops.loss(color, photo, backend="reference")
    value.backward()
    result = step.train(*case.camera(), photo, degree=3, rates=RATES, step=1, background=case.background)
    assert result.loss == pytest.approx(value.item(), rel=2e-5)
    assert result.visible == len(torch.unique(bins.ids))  # one that lies between pixel centres reaches none
    assert result.pairs == len(bins.ids)
    assert result.refused == 0
    # Adam's first step is rate * sign(gradient) in effect; where the gradient is far from 0 it must agree.
    moved = step.parameters()
    rate = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "logit_opacities": 5e-2}
    for name, r in rate.items():
        before = dict(zip(GROUPS, groups, strict=True))[name]
        assert before.grad is not None
        clear = before.grad.abs() > 1e-3 * before.grad.abs().max()
        travelled = (moved[name].double() - before.detach())[clear]
        torch.testing.assert_close(travelled, -r * before.grad.sign()[clear], rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("beta2", [0.999, 0.98])
def test_many_steps_follow_dense_adam(beta2: float) -> None:
    """Five steps of the fused pass against the same gradients given to the reference's Adam."""
    case = scene("adam", 70)
    step = make_step(case)
    mine = {name: g.clone() for name, g in step.parameters().items()}
    m = {name: torch.zeros_like(g) for name, g in mine.items()}
    v = {name: torch.zeros_like(g) for name, g in mine.items()}
    rates = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "logit_opacities": 5e-2}
    for number in range(1, 6):
        gradients = fused_gradients(case, step)
        step.backward_update(*slopes(case), rates=replace(RATES, beta2=beta2), step=number)
        for name, rate in rates.items():
            reference_adam_(
                [mine[name]], [gradients[name]], [m[name]], [v[name]], [rate], step=number, beta2=beta2
            )
            # Float32 roundings of an update of size `rate`, five times over.
            torch.testing.assert_close(
                step.parameters()[name], mine[name], rtol=1e-6, atol=5e-6 * rate * number
            )


@pytest.mark.parametrize("gaussians", [1, 15, 16, 17, 1000])
def test_same_bytes_on_any_number_of_threads(gaussians: int) -> None:
    case = scene("threads", gaussians, width=130, height=70, seed=gaussians)
    photo = photo_of(case)
    runs = [make_step(case, threads) for threads in (1, 2, 3)]
    for number in range(1, 4):
        results = {
            tuple(
                step.train(
                    *case.camera(), photo, degree=3, rates=RATES, step=number, background=case.background
                )
            )
            for step in runs
        }
        assert len(results) == 1
    for step in runs[1:]:
        assert torch.equal(step.blocks, runs[0].blocks)
        assert torch.equal(step.exp_avg_sq, runs[0].exp_avg_sq)
        for score in ("plain_sum", "visible_count", "max_extent"):
            assert torch.equal(getattr(step, score), getattr(runs[0], score)), score


def test_scores_are_what_they_say() -> None:
    """Against autograd of the reference, by the gradient of means2d; visits and extents by the lists and extents."""
    case = scene("scores", 24, width=21, height=19, degree=0)
    step = make_step(case)
    d_color, d_alpha, d_depth = slopes(case)
    fused_gradients(case, step)
    step.backward_update(d_color, d_alpha, d_depth, rates=RATES, step=1)

    _, d_means2d = differentiate(case, "reference", torch.float64)
    ndc = torch.tensor([case.width / 2, case.height / 2], dtype=torch.float64)
    torch.testing.assert_close(
        step.plain_sum.double(),
        (d_means2d * ndc).norm(dim=1),
        rtol=1e-3,
        atol=1e-3 * float((d_means2d * ndc).norm(dim=1).max()),
    )

    projected = case.project(case.groups(torch.float64), case.viewmat.double(), "reference")
    bins = ops.bin(projected, case.width, case.height, backend="reference")
    visible = torch.isin(torch.arange(24), bins.ids)
    assert torch.equal(step.visible_count, visible.float())
    extent = 2 * projected.extents.amax(1) / max(case.width, case.height)
    torch.testing.assert_close(step.max_extent.double(), torch.where(visible, extent, 0.0), rtol=1e-5, atol=0)


def test_scores_that_are_not_asked_for_are_not_kept_and_change_nothing() -> None:
    case = scene("kept", 60)
    photo = photo_of(case)
    scored, bare = make_step(case), make_step(case)
    bare.keep_scores = False
    for number in (1, 2):
        for step in (scored, bare):
            step.train(*case.camera(), photo, degree=3, rates=RATES, step=number)
    assert torch.equal(scored.blocks, bare.blocks)
    for score in ("plain_sum", "visible_count", "max_extent"):
        assert getattr(scored, score).max() > 0, score
        assert torch.count_nonzero(getattr(bare, score)) == 0, score


def test_state_goes_in_and_comes_out_unchanged() -> None:
    case = scene("state", 37)
    step = make_step(case)
    for name, value in zip(GROUPS, case.groups(), strict=True):
        assert torch.equal(step.parameters()[name], value), name
    step.train(*case.camera(), photo_of(case), degree=3, rates=RATES, step=1)
    params, (m, v) = step.parameters(), step.moments()
    assert m.shape == v.shape == (37, 59)
    assert step.visible_count.sum() > 0
    chosen = torch.arange(0, 37, 2)
    step.replace({k: p[chosen] for k, p in params.items()}, m[chosen], v[chosen])
    assert step.count == len(chosen)
    assert all(torch.equal(step.parameters()[k], p[chosen]) for k, p in params.items())
    assert torch.equal(step.moments()[0], m[chosen])
    assert torch.equal(step.moments()[1], v[chosen])
    assert step.visible_count.sum() == 0
    step.replace(params, None, None)
    assert torch.count_nonzero(step.moments()[0]) == 0


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (4, 1), (9, 2)])
def test_coefficients_that_are_not_given_are_0(count: int, degree: int) -> None:
    case = replace(scene("fewer coefficients", 37), degree=degree)
    *others, sh = case.groups()
    padded = torch.cat([sh[:, :count], torch.zeros_like(sh[:, count:])], 1)
    few, all16 = (
        case.project([*others, x], case.viewmat, "cpu") for x in (sh[:, :count].contiguous(), padded)
    )
    assert few.colors.any()
    assert torch.equal(few.colors, all16.colors)


def test_mask_and_kept_statistics() -> None:
    case = scene("mask", 60)
    photo = photo_of(case)
    mask = torch.rand(case.height, case.width, generator=torch.Generator().manual_seed(1)) > 0.4
    stats = photo_stats(photo, mask=mask)
    results = [
        make_step(case).train(*case.camera(), p, degree=3, rates=RATES, step=1, mask=m, photo_stats=s)
        for p, m, s in ((photo, mask, None), (None, None, stats))
    ]
    assert results[0] == results[1]
    color, _, _ = make_step(case).forward(*case.camera(), case.width, case.height, degree=3)
    assert results[0].loss == pytest.approx(
        ops.loss(color.double(), photo, mask=mask, backend="reference").item(), rel=2e-5
    )


def test_a_step_allocates_nothing_that_grows() -> None:
    case = scene("memory", 300)
    photo, step = photo_of(case), make_step(case)
    first = step.train(*case.camera(), photo, degree=3, rates=RATES, step=1)
    addresses = [t.data_ptr() for t in (step._image, step._gradient, step.blocks, step._scores)]
    for number in range(2, 6):
        again = step.train(*case.camera(), photo, degree=3, rates=RATES, step=number)
    assert addresses == [t.data_ptr() for t in (step._image, step._gradient, step.blocks, step._scores)]
    assert again.loss < first.loss


def test_calls_out_of_order_say_so() -> None:
    case = scene("order", 10)
    step = make_step(case)
    d = torch.zeros(case.height, case.width, 3)
    with pytest.raises(RuntimeError, match="call forward first"):
        step.backward_update(d, rates=RATES, step=1)
    step.forward(*case.camera(), case.width, case.height, degree=3)
    step.backward_update(d, rates=RATES, step=1)
    with pytest.raises(RuntimeError, match="call forward first"):
        step.backward_update(d, rates=RATES, step=2)
    with pytest.raises(ValueError, match="step: counts from 1"):
        step.train(*case.camera(), photo_of(case), degree=3, rates=RATES, step=0)
    with pytest.raises(ValueError, match="photo"):
        step.train(*case.camera(), None, degree=3, rates=RATES, step=1)


def test_threads_default_to_what_the_process_may_use() -> None:
    assert Step(*scene("threads", 4).groups()).threads == engine.default_threads()

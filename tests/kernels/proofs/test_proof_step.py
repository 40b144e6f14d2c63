"""The fused CPU training step has the definition's image and gradients, and the Adam update of the ops, on every build.

Not proven here: the gradient to the camera (test_cpu_pose).
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.bounds import within
from tests.support.kernels.cases import CASES, GROUPS
from tests.support.kernels.exact import exact
from tests.support.kernels.proof import EPS, run, use
from tests.support.kernels.units import IMAGES

RATES = Rates(1.6e-4, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4)


def photo(width: int, height: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(
        0, 256, (height, width, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed)
    )


@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize("name", CASES)
def test_image_and_gradients_are_the_definitions(name: str, build: str) -> None:
    known = exact(name)
    case, sure = known.case, ~known.undecided
    with use(f"cpu:{build}"):
        step = Step(*case.groups())
        image = step.forward(
            *case.camera(),
            case.width,
            case.height,
            degree=case.degree,
            background=case.background,
            antialias=case.antialias,
        )
        want = known.want
        for label, got, other in zip(IMAGES, image, (want.color, want.alpha, want.depth), strict=True):
            off = (got.double() - other.detach()).abs()
            within(f"fused, {label}", name, off[sure], known.units.fused[label][sure])
        gradients = step.gradients(*known.weights)
    for k in GROUPS:
        error = gradients[k].double() - known.gradients[k]
        within(f"fused, gradient to {k}", name, error, known.units.fused[k])


@pytest.mark.parametrize("build", isa.supported())
def test_train_is_forward_loss_gradient_and_adam(build: str) -> None:
    case = CASES["ordinary"]()
    rgb = photo(case.width, case.height)
    mask = (torch.rand(case.height, case.width, generator=torch.Generator().manual_seed(1)) > 0.2).to(
        torch.uint8
    )
    with use(f"cpu:{build}"):
        fused, parts = Step(*case.groups()), Step(*case.groups())
        moments = (
            [torch.zeros_like(x) for x in case.groups(torch.float64)],
            [torch.zeros_like(x) for x in case.groups(torch.float64)],
        )
        rates = [RATES.means, RATES.log_scales, RATES.quats, RATES.logit_opacities]
        for t in range(1, 6):
            before = parts.parameters()
            image = parts.forward(
                *case.camera(), case.width, case.height, degree=case.degree, background=case.background
            )
            color = image[0].clone().requires_grad_()
            value = ops.loss(color, rgb, mask=mask, backend="cpu")
            (d_color,) = torch.autograd.grad(value, color)
            gradients = parts.gradients(d_color)
            assert parts.backward_update(d_color, rates=RATES, step=t) == 0
            result = fused.train(
                *case.camera(),
                rgb,
                degree=case.degree,
                rates=RATES,
                step=t,
                background=case.background,
                mask=mask,
            )
            assert result.loss == pytest.approx(float(value.detach()), abs=1e-6)
            assert result.refused == 0

            # Adam, by its definition, on those gradients.
            params = [before[k].double() for k in GROUPS]
            grads = [gradients[k].double() for k in GROUPS]
            sh, sh_m, sh_v, sh_g = params.pop(), moments[0].pop(), moments[1].pop(), grads.pop()
            groups = [*params, sh[:, :1], sh[:, 1:]]
            firsts, seconds = [*moments[0], sh_m[:, :1], sh_m[:, 1:]], [*moments[1], sh_v[:, :1], sh_v[:, 1:]]
            reference.adam_(
                groups,
                [*grads, sh_g[:, :1], sh_g[:, 1:]],
                firsts,
                seconds,
                [*rates, RATES.sh_dc, RATES.sh_rest],
                step=t,
            )
            moments[0].append(sh_m)
            moments[1].append(sh_v)
            after = parts.parameters()
            for k, p, rate in zip(GROUPS, [*params, sh], [*rates, RATES.sh_dc], strict=True):
                # Rounding of the parameter itself, of the update's 16 operations, and of gradients that Adam's
                # quotient magnifies where both moments cancel.
                bound = 2 * EPS * p.abs() + 1e-4 * rate
                assert ((after[k].double() - p).abs() <= bound).all(), k
        for k, x in fused.parameters().items():
            assert torch.allclose(x, parts.parameters()[k], rtol=1e-5, atol=1e-6), k


@pytest.mark.parametrize("build", isa.supported())
def test_threads_do_not_show(build: str) -> None:
    """Twenty steps on one thread and on two leave the same bytes everywhere."""
    case = CASES["portrait"]()
    rgb = photo(case.width, case.height)
    states = []
    with use(f"cpu:{build}"):
        for threads in (1, 2, 3):
            step = Step(*case.groups(), threads=threads)
            for t in range(1, 21):
                result = step.train(
                    *case.camera(), rgb, degree=case.degree, rates=RATES, step=t, background=case.background
                )
            states.append(
                [
                    step.blocks,
                    step.exp_avg,
                    step.exp_avg_sq,
                    step.plain_sum,
                    step.visible_count,
                    step.max_extent,
                    torch.tensor(result.loss),
                ]
            )
    for other in states[1:]:
        for a, b in zip(states[0], other, strict=True):
            assert a.numpy().tobytes() == b.numpy().tobytes()


@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize("name", ["ordinary", "pile of transparent", "side 257x1"])
def test_threads_do_not_show_in_the_ops(name: str, build: str) -> None:
    case = CASES[name]()
    results = []
    g = torch.Generator().manual_seed(5)
    weights = [torch.randn(case.height, case.width, *s, generator=g) for s in ((3,), (), ())]
    before = torch.get_num_threads()
    try:
        with use(f"cpu:{build}"):
            for threads in (1, 2):
                torch.set_num_threads(threads)
                got = run(case, "cpu")
                gradients = got.gradients(*weights)
                results.append(
                    [
                        *got.projected,
                        *got.bins,
                        got.color,
                        got.alpha,
                        got.depth,
                        *(gradients[k] for k in (*GROUPS, "viewmat")),
                    ]
                )
    finally:
        torch.set_num_threads(before)
    for a, b in zip(*results, strict=True):
        assert a.detach().numpy().tobytes() == b.detach().numpy().tobytes()

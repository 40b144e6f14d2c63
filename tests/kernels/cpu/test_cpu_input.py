"""Bad input to the CPU kernels is a sentence that names the argument; odd sizes and empty sets have defined results.

Not proven here: values on ordinary scenes (test_proof_*). Memory errors that leave results alone are for
`make sanitize` to find.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import GROUPS, Case, scene

RATES = Rates(1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-4)


def call_project(case: Case, **changes: Any) -> ops.Projected:
    viewmat, K = case.camera()
    arguments: dict[str, Any] = dict(zip(GROUPS, case.groups(), strict=True))
    arguments |= {
        "viewmat": viewmat,
        "K": K,
        "width": case.width,
        "height": case.height,
        "degree": 3,
    } | changes
    return ops.project(**arguments, backend="cpu")


WRONG: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"means": torch.zeros(5, 2)}, ValueError, r"means: expected shape \[\*, 3\], got \[5, 2\]"),
    (
        {"means": torch.zeros(5, 3, dtype=torch.float64)},
        TypeError,
        "means: expected torch.float32, got torch.float64",
    ),
    ({"means": [1.0, 2.0, 3.0]}, TypeError, "means: expected a tensor, got list"),
    ({"log_scales": torch.zeros(4, 3)}, ValueError, r"log_scales: expected shape \[5, 3\]"),
    ({"quats": torch.zeros(5, 3)}, ValueError, r"quats: expected shape \[5, 4\]"),
    ({"logit_opacities": torch.zeros(5, 1)}, ValueError, r"logit_opacities: expected shape \[5\]"),
    ({"sh": torch.zeros(5, 16)}, ValueError, "sh: expected shape"),
    ({"sh": torch.zeros(5, 9, 3)}, ValueError, "sh: degree 3 needs 16"),
    ({"viewmat": torch.eye(3)}, ValueError, r"viewmat: expected shape \[4, 4\]"),
    ({"viewmat": torch.eye(4).int()}, TypeError, "viewmat: expected torch.float32"),
    ({"K": torch.eye(4)}, ValueError, r"K: expected shape \[3, 3\]"),
    ({"width": 0}, ValueError, "width: expected 1 to"),
    ({"height": 40000}, ValueError, "height: expected 1 to"),
    ({"degree": 4}, ValueError, "degree: expected 0, 1, 2 or 3"),
    ({"near": 0.0}, ValueError, "near: expected a positive distance"),
    ({"near": math.nan}, ValueError, "near: expected a positive distance"),
    (
        {"means": torch.zeros(5, 3, device="meta")},
        ValueError,
        "means: expected a tensor on cpu, got one on meta",
    ),
]


@pytest.mark.parametrize(("changes", "error", "message"), WRONG, ids=lambda x: str(x)[:24])
def test_project_names_the_argument(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call_project(scene("wrong", 5), **changes)


def test_bin_and_composite_name_the_argument() -> None:
    case = scene("wrong", 5)
    projected = call_project(case)
    with pytest.raises(ValueError, match=r"projected.conics: expected shape \[5, 3\]"):
        ops.bin(projected._replace(conics=torch.zeros(5, 2)), case.width, case.height)
    bins = ops.bin(projected, case.width, case.height)
    for wrong, message in (
        (bins._replace(offsets=bins.offsets[:-1]), "bins.offsets: expected shape"),
        (bins._replace(ids=bins.ids.long()), "bins.ids: expected torch.int32"),
        (bins._replace(offsets=bins.offsets + 1), "bins.offsets must run from 0"),
        (bins._replace(offsets=bins.offsets.flip(0)), "bins.offsets must run from 0"),
        (bins._replace(ids=torch.where(bins.ids == 4, 5, bins.ids)), "is 5, but there are 5 Gaussians"),
        (bins._replace(ids=bins.ids - 5), "but there are 5 Gaussians"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            ops.composite(projected, wrong, case.width, case.height)
    falling = bins.offsets.clone()
    falling[1] = bins.offsets[-1] + 7
    with pytest.raises(ValueError, match="must not fall"):
        ops.composite(projected, bins._replace(offsets=falling), case.width, case.height)
    with pytest.raises(ValueError, match=r"background: expected shape \[3\]"):
        ops.composite(projected, bins, case.width, case.height, background=torch.zeros(4))


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 'reference', 'cpu' or 'gpu'"):
        ops.knn(torch.zeros(5, 3), backend="tpu")  # type: ignore[arg-type]  # what is tested
    assert ops.backend_for(torch.zeros(1)) == "cpu"


def test_strides_do_not_matter() -> None:
    case = scene("strides", 33)
    plain = call_project(case)
    turned = call_project(
        case,
        means=case.means.T.contiguous().T,
        sh=case.sh.permute(2, 1, 0).contiguous().permute(2, 1, 0),
        viewmat=case.viewmat.T.contiguous().T,
    )
    assert all(torch.equal(a, b) for a, b in zip(plain, turned, strict=True))
    bins = ops.bin(plain, case.width, case.height)
    strided = plain._replace(colors=plain.colors.T.contiguous().T)
    for a, b in zip(
        ops.composite(plain, bins, case.width, case.height),
        ops.composite(strided, bins, case.width, case.height),
        strict=True,
    ):
        assert torch.equal(a, b)


@pytest.mark.parametrize("height", [1, 15, 16, 17, 257])
@pytest.mark.parametrize("width", [1, 15, 16, 17, 257])
def test_image_sides(width: int, height: int) -> None:
    """Forward and a step at every side against the reference's image; nothing written outside (finite, right shape)."""
    case = scene("sides", 40, width=width, height=height, seed=width + 1000 * height)
    step = Step(*case.groups())
    image = step.forward(*case.camera(), width, height, degree=3, background=case.background)
    projected = ops.project(*case.groups(), *case.camera(), width, height, degree=3, backend="reference")
    bins = ops.bin(projected, width, height, backend="reference")
    exact = ops.composite(projected, bins, width, height, background=case.background, backend="reference")
    for mine, other in zip(image, exact, strict=True):
        assert mine.shape == other.shape
        # 2.7e-6 of the exponential per weight, and float32 on both sides; depths here are up to 6.
        torch.testing.assert_close(mine, other, rtol=3e-5, atol=3e-5)
    photo = torch.zeros(height, width, 3, dtype=torch.uint8)
    result = step.train(*case.camera(), photo, degree=3, rates=RATES, step=1)
    assert math.isfinite(result.loss)
    assert result.refused == 0
    assert bool(torch.isfinite(step.blocks).all())


@pytest.mark.parametrize("n", [0, 30])
def test_nothing_to_see(n: int) -> None:
    """No Gaussians at all, or all behind the camera: the background, zero gradients, and moments that stay zero."""
    case = scene("empty", n)
    behind = -(case.viewmat[:3, :3].T @ case.viewmat[:3, 3]) - 2 * case.viewmat[2, :3]
    case = replace(case, means=behind + 0.1 * case.means)
    step = Step(*case.groups())
    color, alpha, depth = step.forward(
        *case.camera(), case.width, case.height, degree=3, background=case.background
    )
    assert torch.equal(color, case.background.expand(case.height, case.width, 3))
    assert torch.count_nonzero(alpha) == torch.count_nonzero(depth) == 0
    gradients = step.gradients(torch.ones(case.height, case.width, 3))
    assert all(torch.count_nonzero(g) == 0 for g in gradients.values())
    photo = torch.zeros(case.height, case.width, 3, dtype=torch.uint8)
    result = step.train(*case.camera(), photo, degree=3, rates=RATES, step=1)
    assert (result.visible, result.pairs, result.refused) == (0, 0, 0)
    assert all(torch.equal(step.parameters()[k], v) for k, v in zip(GROUPS, case.groups(), strict=True))

    groups = [g.requires_grad_() for g in case.groups()]
    projected = case.project(groups, case.viewmat, "cpu")
    bins = ops.bin(projected, case.width, case.height)
    assert bins.ids.numel() == 0
    image = ops.composite(projected, bins, case.width, case.height)
    torch.cat([x.flatten() for x in image]).sum().backward()
    assert all(g.grad is not None and torch.count_nonzero(g.grad) == 0 for g in groups)


def test_splats_that_cover_more_tiles_than_ever_before() -> None:
    """The buffer of touches starts small and must grow within one call, to the same image as the separate ops'."""
    case = scene("cover", 700, width=640, height=480, seed=3)
    case = replace(case, log_scales=case.log_scales + 3.0, logit_opacities=case.logit_opacities - 3.0)
    step = Step(*case.groups(), threads=1)
    color, _, _ = step.forward(*case.camera(), 640, 480, degree=3)
    assert step.visibility.pairs > 100_000
    projected = call_project(case)
    bins = ops.bin(projected, 640, 480)
    # A pair on the very edge may fall either way: conics round what the step's factor does not.
    assert abs(len(bins.ids) - step.visibility.pairs) <= 5
    other, _, _ = ops.composite(projected, bins, 640, 480)
    torch.testing.assert_close(color, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-40])
def test_poison_reaches_no_other_pixel_of_the_step(value: float) -> None:
    """One bad number in each slot of one Gaussian: the image is that without the Gaussian, or finite where the
    number is a valid one."""
    case = scene("poison", 16, width=33, height=31)
    without = Step(*(g[1:] for g in case.groups()))
    clean = without.forward(*case.camera(), 33, 31, degree=3)[0].clone()
    for group in range(5):
        width = case.groups()[group][0].numel()
        for slot in range(0, width, max(1, width // 6)):
            groups = case.groups()
            groups[group][0].view(-1)[slot] = value
            step = Step(*groups)
            color, _, _ = step.forward(*case.camera(), 33, 31, degree=3)
            if math.isfinite(value):
                assert bool(torch.isfinite(color).all()), (GROUPS[group], slot)
            else:
                assert torch.equal(color, clean), (GROUPS[group], slot)
            photo = torch.zeros(31, 33, 3, dtype=torch.uint8)
            step.train(*case.camera(), photo, degree=3, rates=RATES, step=1)
            others = {k: p[1:] for k, p in step.parameters().items()}
            assert all(bool(torch.isfinite(p).all()) for p in others.values()), (GROUPS[group], slot)


def tensors(*shape: int) -> Tensor:
    return torch.zeros(*shape)


def test_step_names_the_argument() -> None:
    case = scene("wrong", 5)
    good: dict[str, Any] = dict(zip(GROUPS, case.groups(), strict=True))
    with pytest.raises(ValueError, match=r"sh: expected shape \[5, 16, 3\]"):
        Step(**(good | {"sh": tensors(5, 9, 3)}))
    step = Step(**good)
    with pytest.raises(ValueError, match=r"exp_avg: expected shape \[5, 59\]"):
        step.replace(good, tensors(5, 58), None)
    with pytest.raises(ValueError, match="width: expected 1 to"):
        step.forward(*case.camera(), 0, 10, degree=3)
    step.forward(*case.camera(), case.width, case.height, degree=3)
    with pytest.raises(ValueError, match="d_color: expected shape"):
        step.backward_update(tensors(3, case.height, case.width), rates=RATES, step=1)
    with pytest.raises(ValueError, match="d_alpha: expected shape"):
        step.gradients(tensors(case.height, case.width, 3), tensors(3, 3))
    with pytest.raises(TypeError, match=r"photo: expected torch.uint8"):
        step.train(*case.camera(), tensors(case.height, case.width, 3), degree=3, rates=RATES, step=1)
    with pytest.raises(ValueError, match="mask: expected shape"):
        step.train(
            *case.camera(),
            torch.zeros(case.height, case.width, 3, dtype=torch.uint8),
            degree=3,
            rates=RATES,
            step=1,
            mask=torch.zeros(3, 3, dtype=torch.uint8),
        )

"""The GPU's records keep what a conic loses: needles on the image and beside it, the lists, and the gates.

In Triton's interpreter where there is no GPU. Not proven there: the device's approximate 2^x and division.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)

from _studies.stability import scenes
from _studies.stability.conditioning import Problem, Values, state
from _studies.stability.engines import chain, fused, fused_gpu

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.gpu import bin as gpu_bin
from splatmill_worker.kernels.gpu import device, record
from splatmill_worker.kernels.gpu.blended import PLANES, SEGMENT
from splatmill_worker.kernels.gpu.composite import blend
from splatmill_worker.kernels.gpu.project import project_records
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import ALPHA_MAX, Bins, Rates
from tests.support.kernels.cases import GROUPS, Case, scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's, in lanes that are masked
]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
LIMIT = 4.0
"""Units of conditioning (`_studies.stability.conditioning`) that an engine which trains may be off; 2.6 is the
most that was measured (worker/bench/stability.md)."""


def worst(problem: Problem, engine: Callable[[Problem], Values]) -> float:
    """The worst Gaussian's gradient error over all groups, in units of conditioning."""
    got = engine(problem)
    ratios = []
    for name in GROUPS:
        error = got.gradients[name].double() - problem.exact.gradients[name]
        unit = problem.designed.gradients[name]
        ratios.append(error.reshape(len(error), -1).norm(dim=1) / unit.reshape(len(unit), -1).norm(dim=1))
    return float(torch.nan_to_num(torch.stack(ratios), nan=float("inf")).max())


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_needles_on_the_image_are_as_exact_as_their_inputs(ratio: float) -> None:
    assert worst(state(scenes.few_needles(ratio, 0), 4), fused_gpu) <= LIMIT


@pytest.mark.parametrize("ratio", [3e3, 1e5])
def test_needles_beside_the_image_are_as_exact_as_in_the_cpus_step_and_a_conic_is_not(ratio: float) -> None:
    problem = state(scenes.few_needles_beside(ratio, 0), 4)
    error = worst(problem, fused_gpu)
    # The roundings of both are the same in kind and number; which of them add up is chance.
    assert error <= 2 * worst(problem, fused)
    assert worst(problem, chain) > 100 * error


@pytest.mark.parametrize("ratio", [3e3, 1e6])
def test_no_list_leaves_out_a_pair_that_compositing_would_blend(ratio: float) -> None:
    """The image by lists is, bit for bit, that in which every tile has every Gaussian."""
    for seed in range(2):
        case = scenes.few_needles_beside(ratio, seed)
        groups = tuple(x.to(DEVICE) for x in case.groups(torch.float32))
        camera = case.viewmat.float().to(DEVICE), case.K.float().to(DEVICE)
        records = project_records(
            groups, *camera, case.width, case.height, degree=3, near=0.01, antialias=False
        )
        made = gpu_bin.lists(records, case.width, case.height, None).bins
        order = torch.argsort(record.depths(records), stable=True)
        order = order[record.visible(records)[order]].int()
        tiles = len(made.offsets) - 1
        every = Bins(torch.arange(tiles + 1, device=DEVICE) * len(order), order.repeat(tiles))
        assert len(made.ids) < len(every.ids), "the lists leave out nothing, and this shows nothing"
        images = [
            blend(records, bins, case.width, case.height, None, depth=True, checkpoints=False)
            for bins in (made, every)
        ]
        assert torch.equal(images[0].color, images[1].color)
        assert torch.equal(images[0].transmittance, images[1].transmittance)


def test_lists_have_a_margin_for_the_roundings_of_u_and_no_more() -> None:
    """A needle that passes a tile's corner at distances around the cut, its centre 4000 pixels away: it is listed
    wherever u, rounded as unluckily as it may be, could be found within the cut, and not four times as far out.
    """
    ux, away = 30.0, 3000.0  # 1 / pixels, pixels
    edge = torch.log2(torch.tensor(255.0, dtype=torch.float64)).sqrt()
    worst_rounding = 3 * 2.0**-24 * 2 * ux * away
    y = torch.tensor(away + 0.5 - float(edge) / ux)
    cases = set()
    for _ in range(60):
        y = torch.nextafter(y, torch.tensor(0.0))
        row = torch.zeros(1, record.WIDTH)
        row[0, :2] = torch.stack([torch.tensor(0.5 - away), y])
        row[0, record.SHAPE] = torch.tensor([ux, ux, 1e-4])
        row[0, record.EXTENT] = away * 1.1  # pixels
        row[0, record.DEPTH_PLACE] = 1.0
        u = ux * (0.5 - row[0, 0].double()) + ux * (0.5 - row[0, 1].double())
        outside = float((u - edge) / worst_rounding)
        listed = bool(len(gpu_bin.lists(row.to(DEVICE), 16, 1, None).bins.ids))
        if outside <= 1:
            assert listed, f"{outside} of the worst rounding outside"
        if outside > 4:
            assert not listed, f"{outside} of the worst rounding outside"
        cases.add((outside <= 1, outside > 4))
    assert len(cases) == 3, "one of the three cases did not occur"


def one(level: float, sh: float = 1.0) -> Step:
    """A scene of one wide Gaussian over a pixel."""
    return Step(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 2.0), torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([level]), torch.full((1, 1, 3), sh), where=DEVICE,
    )  # fmt: skip


CAMERA = torch.eye(4), torch.tensor([[4.0, 0, 0.5], [0, 4.0, 0.5], [0, 0, 1.0]]), 1, 1


def test_the_gradient_ends_where_alpha_is_clamped_and_not_before() -> None:
    opaque, clear = one(12.0), one(2.0)
    gradients = []
    for step in (opaque, clear):
        color, alpha, _ = step.forward(*CAMERA, degree=0)
        gradients.append(step.gradients(torch.ones_like(color)))
        assert float(alpha) == pytest.approx(
            min(ALPHA_MAX, float(torch.sigmoid(step.parameters()["logit_opacities"]))), rel=1e-6
        )
    assert not gradients[0]["logit_opacities"].any()
    assert gradients[0]["sh"].any()
    # d alpha / d logit = o (1 - o), times the three colours; 2^x is good to 2.7e-6 on any engine.
    o = torch.sigmoid(torch.tensor(2.0, dtype=torch.float64))
    want = 3 * (0.5 + 0.28209479177387814) * o * (1 - o)
    assert float(gradients[1]["logit_opacities"]) == pytest.approx(float(want), rel=1e-5)


def test_a_logit_of_16_still_has_its_gradient() -> None:
    """o (1 - o) in float32 has no digit left from a logit of 16 on; o e^-x / (1 + e^-x) has all. The Gaussian is seen
    where its alpha is a half.
    """
    wide = Step(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 0.2), torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([16.0]), torch.ones(1, 1, 3), where=DEVICE,
    )  # fmt: skip
    viewmat, K, width, height = CAMERA
    K = K.clone()
    K[0, 2] = -2.4
    color, alpha, _ = wide.forward(viewmat, K, width, height, degree=0)
    assert 0.1 < float(alpha) < 0.9
    got = float(wide.gradients(torch.ones_like(color))["logit_opacities"])
    against = float(torch.sigmoid(torch.tensor(-16.0, dtype=torch.float64)))
    assert got == pytest.approx(float(color.sum()) * against, rel=1e-5)


BACKENDS: tuple[ops.Backend, ...] = ("reference", "gpu")


@pytest.mark.skipif(
    DEVICE == "cuda", reason="a device fuses product and sum, which then miss 0 by a rounding"
)
def test_a_colour_of_exactly_0_has_the_gradient_that_the_definition_gives_it() -> None:
    """torch's clamp passes the gradient where its argument equals the bound, and so do the kernels."""
    coefficient = torch.tensor(-0.5 / 0.28209479177387814)
    candidates = [coefficient]
    for up in (-10.0, 10.0):
        x = coefficient
        for _ in range(6):
            x = torch.nextafter(x, torch.tensor(up))
            candidates.append(x)
    groups = [
        torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 2.0), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1),
    ]  # fmt: skip
    for x in candidates:
        results = []
        for backend in BACKENDS:
            where = DEVICE if backend == "gpu" else "cpu"
            sh = torch.full((1, 1, 3), float(x), device=where, requires_grad=True)
            means, log_scales, quats, logits = (g.to(where) for g in groups)
            fields = ops.project(
                means, log_scales, quats, logits, sh, CAMERA[0].to(where), CAMERA[1].to(where), 1, 1,
                degree=0, backend=backend,
            )  # fmt: skip
            fields.colors.sum().backward()
            assert sh.grad is not None
            results.append((float(fields.colors[0, 0].detach()), float(sh.grad[0, 0, 0])))
        if results[0][0] == results[1][0] == 0.0 and results[0][1] > 0:
            assert results[1][1] == pytest.approx(0.28209479177387814)
            return
    pytest.fail("no coefficient gives a colour of exactly 0 in both")


def test_a_pair_is_reckoned_with_its_share_of_the_checkpoints() -> None:
    pairs = 10 * SEGMENT
    lists = Bins(
        torch.zeros(2, dtype=torch.int64, device=DEVICE), torch.zeros(pairs, dtype=torch.int32, device=DEVICE)
    )
    made = blend(
        torch.zeros(1, record.WIDTH, device=DEVICE), lists, 16, 16, None, depth=False, checkpoints=True
    )
    assert made.checkpoints is not None
    last_of_a_tile = PLANES * 16 * 16 * 4
    share = (made.checkpoints.nbytes - last_of_a_tile) / pairs
    # PAIR_BYTES is a whole number.
    assert abs(device.PAIR_BYTES / device.ROOM - device.LIST_BYTES - share) < 0.5


def small() -> Case:
    return scene("records", 6, width=20, height=12, seed=31)


def test_a_culled_gaussian_in_a_list_shows_nothing() -> None:
    case = small()
    behind = case.means.clone()
    behind[0] = case.means[0] - 20.0 * case.viewmat[2, :3]
    case = replace(case, means=behind)
    groups = [x.to(DEVICE) for x in case.groups()]
    projected = case.project(groups, case.viewmat.to(DEVICE), "gpu")
    assert not projected.extents[0].any()
    assert projected.opacities[0] == 0
    ids = torch.zeros(2, dtype=torch.int32, device=DEVICE)
    lists = Bins(torch.tensor([0, 1, 2], device=DEVICE), ids)
    color, alpha, _ = ops.composite(projected, lists, case.width, case.height, backend="gpu")
    assert not alpha.any()
    assert not color.any()


def test_records_and_fields_say_the_same() -> None:
    case = small()
    groups = [x.to(DEVICE) for x in case.groups()]
    fields = case.project(groups, case.viewmat.to(DEVICE), "gpu")
    again = record.fields(record.pack(fields))
    for name, a, b in zip(fields._fields, fields, again, strict=True):
        # A conic goes through a determinant, which for these round Gaussians cancels to some tenths of its terms.
        assert torch.allclose(a, b, rtol=2e-6, atol=0), name


def test_gradients_change_nothing_and_are_those_that_an_update_takes() -> None:
    case = small()
    step = Step(*case.groups(), where=DEVICE)
    with pytest.raises(RuntimeError, match="needs a forward pass"):
        step.gradients(torch.zeros(case.height, case.width, 3))
    before = step.parameters()
    color, _, _ = step.forward(case.viewmat, case.K, case.width, case.height, degree=case.degree)
    weights = torch.randn(color.shape, generator=torch.Generator().manual_seed(1))
    gradients = step.gradients(weights)
    assert not step.max_extent.any()
    for name, value in step.parameters().items():
        assert torch.equal(value, before[name]), name
    step.backward_update(weights, rates=Rates(*[1e-3] * 6), step=1)
    packed = torch.cat([gradients[name].reshape(len(case.means), -1) for name in GROUPS], 1)
    # Adam's first moment is 0.1 g; the two passes may add in another order.
    assert torch.allclose(step.moments()[0], 0.1 * packed, rtol=1e-4, atol=1e-7)

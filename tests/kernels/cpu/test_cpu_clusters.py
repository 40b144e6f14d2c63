"""Steps that leave out clusters of Gaussians out of view are those of dense Adam: what was missed is made up for, boxes
leave out nothing that is drawn, and callers see no other order.

Not proven here: the steps themselves (test_cpu_step), and what they save (`splatmill bench scale`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import reference
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.kernels.records import EPS, Rates
from splatmill_worker.splat.train.dropout import dropout
from tests.support.kernels.bounds import at_most

WIDTH, HEIGHT = 64, 48
K = torch.tensor([[60.0, 0, 30], [0, 62, 25], [0, 0, 1]])
RATES = Rates(means=2e-3, log_scales=5e-3, quats=1e-3, logit_opacities=5e-2, sh_dc=2.5e-3, sh_rest=1.25e-4)
CLUSTER = 256
WIDTHS = [3, 3, 4, 1, 3, 45]
FIRST = [0, 3, 6, 10, 11, 14]
"""Parameters of a Gaussian with one learning rate, and the first of them."""
NAMES = ("means", "log_scales", "quats", "logit_opacities", "sh")
SCORES = ("plain_sum", "visible_count", "max_extent")


def street(n: int = 3000, seed: int = 0, sort: bool = True) -> list[Tensor]:
    """Gaussians along a street of length 40, much longer than what a camera shows of it."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g) * torch.tensor([40.0, 2.0, 2.0])
    groups = [
        means,
        torch.randn(n, 3, generator=g) * 0.4 - 2.5,
        torch.randn(n, 4, generator=g),
        torch.randn(n, generator=g),
        torch.randn(n, 16, 3, generator=g) * 0.2,
    ]
    order = morton_order(means, cubic=True) if sort else torch.arange(n)
    return [group[order].contiguous() for group in groups]


def camera(at: float) -> Tensor:
    """At z = -3 beside the street, looking across it."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-at, -1.0, 3.0])
    return viewmat


def anywhere(seed: int) -> tuple[Tensor, Tensor, float]:
    """A camera in or near the street with any direction: viewmat, K off centre, near plane."""
    g = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))
    turn[0] *= torch.linalg.det(turn)
    centre = torch.rand(3, generator=g, dtype=torch.float64) * torch.tensor([44.0, 8, 8]) - 3
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ centre
    focal = 10.0 ** (1 + 2 * float(torch.rand((), generator=g)))
    middle = torch.rand(2, generator=g) * torch.tensor([2.0 * WIDTH, 2.0 * HEIGHT]) - 20
    intrinsics = torch.tensor([[focal, 0, middle[0]], [0, 1.1 * focal, middle[1]], [0, 0, 1]])
    return viewmat.float(), intrinsics, 0.01 if seed % 2 else 1.0


def photo(seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)


def train(step: Step, number: int, at: float, rates: Rates = RATES, degree: int = 3) -> None:
    step.train(camera(at), K, photo(number), degree=degree, rates=rates, step=number)


def chosen(step: Step) -> set[int]:
    assert step._clusters is not None
    return set(step._clusters.chosen)


def state(step: Step) -> list[Tensor]:
    return [t.clone() for t in (step.blocks, step.exp_avg, step.exp_avg_sq)]


def test_a_view_chooses_the_clusters_near_it() -> None:
    step = Step(*street(), clustered=True)
    assert step._clusters is not None
    assert step._clusters.count == -(-3000 // CLUSTER)
    train(step, 1, 5.0)
    left = chosen(step)
    train(step, 2, 35.0)
    right = chosen(step)
    assert 0 < len(left) < step._clusters.count / 2
    assert 0 < len(right) < step._clusters.count / 2
    assert not left & right


def test_with_all_in_view_the_bytes_are_those_of_dense_steps() -> None:
    """Given in Morton order: sums and ties do not depend on another one."""
    groups = street(700)
    runs = [Step(*groups), Step(*groups, clustered=True)]
    far = torch.eye(4)
    far[:3, 3] = torch.tensor([-20.0, -1.0, 60.0])
    for number in range(1, 6):
        for step in runs:
            step.train(far, K, photo(number), degree=3, rates=RATES, step=number, pose_gradient=True)
        assert len(chosen(runs[1])) == 3
    for a, b in zip(state(runs[0]), state(runs[1]), strict=True):
        assert torch.equal(a, b)
    assert runs[0].pose_gradient is not None
    assert runs[1].pose_gradient is not None
    assert torch.equal(runs[0].pose_gradient, runs[1].pose_gradient)
    for score in SCORES:
        assert torch.equal(getattr(runs[0], score), getattr(runs[1], score)), score


@pytest.mark.parametrize("beta2", [0.999, 0.98, 0.95])
@pytest.mark.parametrize("seed", range(3))
def test_what_was_missed_is_what_dense_adam_does_with_zero_gradients(seed: int, beta2: float) -> None:
    """Random views, rates that change at every step: returns of clusters against float64 steps of Adam, with eps.

    The bound, relative to the way that dense Adam takes: 2e-9 for the terms after the 256th, 2 eps / sqrt(v) with the
    last v for eps, and 32 u for the roundings of the root (4.4 ulp), the quotient (2.8 ulp) and four products. The
    parameter itself is rounded once.
    """
    g = torch.Generator().manual_seed(seed)
    step = Step(*street(seed=seed), clustered=True)
    assert step._clusters is not None
    count, u = step._clusters.count, 2.0**-24
    left: dict[
        int, tuple[int, list[Tensor]]
    ] = {}  # at which step a cluster was last moved, and what it was then
    used: list[Rates] = []
    returns = 0
    for number in range(1, 281):
        at = 40.0 * float(torch.rand((), generator=g))
        faded = float(torch.rand((), generator=g)) * 0.99**number + 1e-3
        rates = replace(
            RATES, beta2=beta2, means=RATES.means * faded, logit_opacities=RATES.logit_opacities * faded
        )
        step.forward(camera(at), K, WIDTH, HEIGHT, degree=2)
        back = [cluster for cluster in chosen(step) if left.get(cluster, (number,))[0] < number - 1]
        for cluster in back[:1]:
            last, before = left[cluster]
            rows = slice(16 * cluster, 16 * cluster + 16)
            x, m, v = (t.double() for t in before)
            way = torch.zeros_like(x)
            for missed in range(last + 1, number):
                unmoved, rates_then = x.clone(), [used[missed - 1].rows()[first] for first in FIRST]
                values, zeros, first, second = (
                    t.split(WIDTHS, dim=1) for t in (x, torch.zeros_like(x), m, v)
                )
                reference.adam_(values, zeros, first, second, rates_then, step=missed, beta2=beta2)
                way += (x - unmoved).abs()
            after = (step.blocks[rows].double(), step.exp_avg[rows].double(), step.exp_avg_sq[rows].double())
            deviation = (v / beta2 ** (number - 1 - last)).sqrt().clamp_min(EPS)
            allowed = (
                way * (32 * u + 2e-9)
                + 2 * u * x.abs()
                + way * 2 * EPS / deviation * beta2 ** (-(number - 1 - last) / 2)
            )
            moving = slice(0, 11 + 3 * 9)
            at_most(
                "clusters: way",
                f"{seed} {beta2}",
                (after[0] - x)[:, moving].abs(),
                allowed[:, moving] + 1e-30,
            )
            for name, a, b in (("m", after[1], m), ("v", after[2], v)):
                # One power and one product; below the smallest normal number, float32 has 0.
                at_most(f"clusters: {name}", f"{seed} {beta2}", (a - b).abs(), b.abs() * 4 * u + 2.0**-126)
            returns += 1
        step.train(camera(at), K, photo(number), degree=2, rates=rates, step=number)
        used.append(rates)
        for cluster in chosen(step):
            rows = slice(16 * cluster, 16 * cluster + 16)
            left[cluster] = (number, [t[rows].clone() for t in (step.blocks, step.exp_avg, step.exp_avg_sq)])
    assert len(left) == count
    assert returns > 20


@pytest.mark.parametrize("seed", range(6))
def test_boxes_leave_out_nothing_that_is_drawn(seed: int) -> None:
    """After steps with large rates, in which Gaussians out of view drift by their own size: every camera shows the same
    bytes as of the whole scene, with large, long and broken Gaussians among them, and opacities that were written to.
    """
    wild = replace(RATES, means=0.3, log_scales=0.3)
    groups = street(2500, seed)
    groups[1][::100] += torch.tensor([3.0, 0.0, -3.0])
    groups[1][7] = 60.0
    groups[0][40] = torch.tensor([math.nan, 0.0, 0.0])
    groups[0][41, 1] = math.inf
    groups[1][42, 2] = math.nan
    step = Step(*groups, clustered=True)
    fewest, drifted = step.count, 0.0
    for number in range(1, 41):
        train(step, number, float(number // 5 * 17 % 40), wild)
        if number % 5:
            continue
        step.logit_opacities[::3] = 9.0
        for which in range(4):  # the first one meets what drifted in the steps before
            skewed, intrinsics, near = anywhere(1000 * seed + 10 * number + which)
            before = step.blocks.clone()
            images = step.forward(skewed, intrinsics, WIDTH, HEIGHT, degree=3, near=near)
            shown = [image.clone() for image in images]
            fewest = min(fewest, CLUSTER * len(chosen(step)))
            whole = Step(*(value[step._order] for value in step.parameters().values()))
            drifted = max(drifted, float((step.blocks - before)[:, :3].nan_to_num().abs().max()))
            expected = whole.forward(skewed, intrinsics, WIDTH, HEIGHT, degree=3, near=near)
            assert step.visibility == whole.visibility
            for a, b in zip(shown, expected, strict=True):
                assert torch.equal(a, b)
    assert fewest < step.count / 2
    assert drifted > 0.08  # the median standard deviation of a Gaussian


@pytest.mark.parametrize("drifting", [None, "means", "log_scales"])
@pytest.mark.parametrize("side", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
def test_a_box_ends_where_its_last_gaussian_leaves_the_picture(
    side: tuple[int, int, int], drifting: str | None
) -> None:
    """256 equal Gaussians, past which a camera moves in small steps: they are computed as long as they are drawn, and
    not much longer. With `drifting`, moments make them follow the camera, or grow, while it looks elsewhere.
    """
    towards = torch.tensor(side).float()
    groups = [torch.zeros(CLUSTER, *shape) for shape in ((3,), (3,), (4,), (), (16, 3))]
    groups[1] += -3.0
    groups[2][:, 0] = 1.0
    groups[3] += 9.0
    m, v = torch.zeros(CLUSTER, 59), torch.zeros(CLUSTER, 59)
    if drifting is not None:
        # Along the way of the camera; and all three scales alike.
        m[:, FIRST[NAMES.index(drifting)] :][:, :3] = -7.0 * (
            towards if drifting == "means" else torch.ones(3)
        )
        v[m != 0] = 1.0
    rates = replace(RATES, means=0.01, log_scales=0.05)
    away = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    away[2, 3] = -100.0
    drawn: list[bool] = []
    still: list[bool] = []
    computed: list[bool] = []
    for number in range(150):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([0.0, 0.0, 5.0]) - towards * 0.05 * number
        step = Step(*groups, clustered=True)
        step.replace(dict(zip(NAMES, groups, strict=True)), m, v)
        for count in range(5 if drifting else 0):
            step.train(away, K, photo(0), degree=0, rates=rates, step=1000 + count)
            assert not chosen(step)
        step.forward(viewmat, K, WIDTH, HEIGHT, degree=0)
        whole = Step(*step.parameters().values())
        for each, into in ((whole, drawn), (Step(*groups), still)):
            each.forward(viewmat, K, WIDTH, HEIGHT, degree=0)
            into.append(each.visibility.visible > 0)
        computed.append(bool(chosen(step)))
        assert step.visibility == whole.visibility, number
    assert drawn[0]
    assert not computed[-1]
    assert sum(computed) - sum(drawn) <= 8
    assert sum(drawn) - sum(still) >= (2 if drifting and (drifting == "means" or not side[2]) else 0)


@pytest.mark.parametrize("threads", [1, 3])
def test_same_bytes_on_any_number_of_threads(threads: int) -> None:
    runs = [Step(*street(1001), threads=n, clustered=True) for n in (2, threads)]
    for number in range(1, 9):
        for step in runs:
            train(step, number, float(number * 11 % 40))
    for a, b in zip(state(runs[0]), state(runs[1]), strict=True):
        assert torch.equal(a, b)


def test_reading_changes_nothing_but_roundings() -> None:
    read, unread = (Step(*street(), clustered=True) for _ in range(2))
    for number in range(1, 40):
        for step in (read, unread):
            train(step, number, float(number * 11 % 40))
        read.parameters()
    for name, value in unread.parameters().items():
        # A step of Adam is at most ten rates long, and its sign may differ where a gradient is nothing but rounding.
        torch.testing.assert_close(read.parameters()[name], value, rtol=1e-3, atol=2e-2, msg=name)


@pytest.mark.parametrize("later", [{"degree": 1}, {"rates": replace(RATES, beta2=0.97)}])
def test_another_degree_or_average_finds_all_clusters_up_to_date(later: dict[str, object]) -> None:
    """What was missed before is made up for as it was missed: the moments of a cluster that never returned tell."""
    step = Step(*street(), clustered=True)
    train(step, 1, 5.0)
    away = min(chosen(step))
    rows = slice(16 * away, 16 * away + 16)
    _, m, v = (t[rows].clone() for t in state(step))
    for number in range(2, 6):
        train(step, number, 35.0)
    train(step, 6, 35.0, **later)  # type: ignore[arg-type]  # a degree or rates, by name
    assert away not in chosen(step)
    assert v.any()
    used = slice(0, 59)
    torch.testing.assert_close(step.exp_avg[rows][:, used], m[:, used] * 0.9**4, rtol=1e-6, atol=1e-37)
    torch.testing.assert_close(step.exp_avg_sq[rows][:, used], v[:, used] * 0.999**4, rtol=1e-6, atol=1e-37)


def test_callers_see_their_own_order() -> None:
    groups = street(900, sort=False)
    step, dense = Step(*groups, clustered=True), Step(*groups)
    for name, group in zip(NAMES, groups, strict=True):
        assert torch.equal(step.parameters()[name], group), name
    for each in (step, dense):
        train(each, 1, 20.0)
    for name, value in dense.parameters().items():
        torch.testing.assert_close(step.parameters()[name], value, rtol=1e-5, atol=1e-6, msg=name)
    for a, b in zip(step.moments(), dense.moments(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-9)
    for score in SCORES:
        torch.testing.assert_close(
            getattr(step, score), getattr(dense, score), rtol=1e-4, atol=1e-9, msg=score
        )
    gradients = []
    for each in (step, dense):
        each.replace(dict(zip(NAMES, groups, strict=True)), *dense.moments())
        color, _, _ = each.forward(camera(20.0), K, WIDTH, HEIGHT, degree=3)
        gradients.append(each.gradients(torch.ones_like(color)))
        assert torch.equal(each.moments()[1], dense.moments()[1])
    for name, value in gradients[1].items():
        torch.testing.assert_close(gradients[0][name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_a_step_without_some_gaussians_gives_their_opacities_back() -> None:
    step, plain = (Step(*street(), clustered=True) for _ in range(2))
    for number in range(1, 4):
        for each in (step, plain):
            train(each, number, 5.0)
    before = plain.parameters()["logit_opacities"]
    with dropout(step.logit_opacities, 0.2, seed=1):
        train(step, 4, 35.0)
    after = step.parameters()["logit_opacities"]
    far = plain.parameters()["means"][:, 0] < 20
    # Those out of view moved by their moments: at most 65 rates in all, and rounding from logits of up to 20.
    assert (after - before)[far].abs().max() < 65 * RATES.logit_opacities
    train(plain, 4, 35.0)
    torch.testing.assert_close(after[far], plain.parameters()["logit_opacities"][far], rtol=0, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257])
def test_any_number_of_gaussians(count: int) -> None:
    step = Step(*street(count), clustered=True)
    for number in (1, 2, 3):
        train(step, number, (5.0, 35.0, 5.0)[number - 1])
    assert step.count == count
    assert all(bool(value.isfinite().all()) for value in step.parameters().values())
    assert len(step.plain_sum) == count

"""Proves `bench stiffness`: Lanczos, the limits, the Hessian's products, the growth of needles' condition numbers, and
that a small run of every part leaves its rows and report.

Not proven here: the figures of its report, and that a real scene's largest eigenvalue is found in the products allowed.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from _studies.stability import scenes
from _studies.stiffness import exact, mean_square, needles
from _studies.stiffness.curvature import LIMIT, Metric, Objective, Shot, joined, product, start
from _studies.stiffness.lanczos import largest

from splatmill_worker.kernels.cpu.loss import photo_stats
from splatmill_worker.kernels.records import Rates

bench = importlib.import_module("stiffness")

RATES = Rates(1e-3, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4)


def problem(count: int = 6) -> tuple[Objective, torch.Tensor, Metric]:
    """A few Gaussians in 16 x 16 pixels before a random photo, and Adam's metric for moments of one gradient."""
    scene = scenes.cloud(count, width=16, height=16, focal=14.0)
    x = joined(
        dict(
            zip(
                ("means", "log_scales", "quats", "logit_opacities", "sh"),
                scene.groups(torch.float64),
                strict=True,
            )
        )
    )
    photo = torch.randint(60, 200, (16, 16, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    shot = Shot(
        scene.viewmat.float(), scene.K.float(), photo, None, torch.tensor([0.2, 0.5, 0.7]), photo_stats(photo)
    )
    objective = Objective([shot], degree=1)
    gradient = objective.gradient(x)
    return objective, x, Metric.of(gradient**2 * (1 - 0.999**10), RATES, 10)


def dense(apply: Callable[[torch.Tensor], torch.Tensor], shape: torch.Size) -> torch.Tensor:
    """The matrix of an operator on tensors of a shape."""
    units = torch.eye(shape.numel(), dtype=torch.float64).reshape(-1, *shape)
    return torch.stack([apply(unit).reshape(-1) for unit in units], 1)


def test_lanczos_finds_the_largest_eigenvalue_of_a_matrix_with_copies_of_it() -> None:
    g = torch.Generator().manual_seed(1)
    turn, _ = torch.linalg.qr(torch.randn(60, 60, generator=g, dtype=torch.float64))
    values = torch.cat([torch.linspace(-30, 8, 57, dtype=torch.float64), torch.tensor([9.0, 9.0, 9.0])])
    matrix = turn @ torch.diag(values) @ turn.T
    top = largest(
        lambda u: matrix @ u, torch.randn(60, generator=g, dtype=torch.float64), tolerance=1e-8, most=60
    )
    assert top.value == pytest.approx(9.0, abs=1e-8)
    assert (matrix @ top.vector - 9.0 * top.vector).norm() <= 1e-6
    assert top.error <= 1e-6


def test_the_residual_of_lanczos_bounds_its_error() -> None:
    values = torch.linspace(0, 1, 400, dtype=torch.float64) ** 0.5
    top = largest(lambda u: values * u, torch.ones(400, dtype=torch.float64), tolerance=0.05)
    assert top.products < 30
    assert top.value <= 1.0
    assert (values - top.value).abs().min() <= top.error


def test_ritz_weights_estimate_the_share_of_eigenvalues_above_a_level() -> None:
    values = torch.cat([torch.full((900,), 1.0), torch.full((100,), 50.0)]).double()
    u = torch.randn(1000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert largest(lambda v: values * v, u, tolerance=1e-9).share_above(LIMIT) == pytest.approx(0.1, abs=0.04)


def test_lanczos_agrees_with_the_dense_hessian_of_a_scene() -> None:
    objective, x, metric = problem(2)
    apply = exact.product(objective, x, metric)
    matrix = dense(apply, x.shape)
    assert (matrix - matrix.T).abs().max() <= 1e-10 * matrix.abs().max()
    top = largest(apply, start(metric), tolerance=1e-6, most=200)
    assert top.value == pytest.approx(float(torch.linalg.eigvalsh(matrix)[-1]), rel=1e-6)


def test_products_by_differences_of_the_fused_step_are_those_of_float64() -> None:
    """The step's gradient is rounded to about 1e-6 of its norm and divided by the length of the difference; over a
    fortieth of a step, curvature changes by less than the tolerance."""
    objective, x, metric = problem()
    true, fast = exact.product(objective, x, metric), product(objective.gradient, x, metric, share=1 / 40)
    top = largest(true, start(metric), tolerance=1e-3, most=60)
    assert (fast(top.vector) - true(top.vector)).norm() <= 0.05 * true(top.vector).norm()
    u, v = true(start(metric, 1)), true(start(metric, 2))
    u, v = u / u.norm(), v / v.norm()
    assert abs(float((u * fast(v)).sum() - (v * fast(u)).sum())) <= 0.05 * float(fast(u).norm())


def test_a_metric_leaves_out_values_that_had_no_gradient() -> None:
    square = torch.ones(2, 59)
    square[0, 3] = 0.0
    metric = Metric.of(square, RATES, 1000)
    assert metric.root[0, 3] == 0
    assert metric.root[1, 3] ** 2 == pytest.approx(5e-3 * math.sqrt(1 - 0.999**1000))
    assert (metric.within("quats").root != 0).sum() == 8


@pytest.mark.parametrize("curvature", [37.0, 39.0])
def test_adam_on_a_quadratic_is_stable_below_38_only(curvature: float) -> None:
    x, m = 1.0, 0.0
    for _ in range(2000):
        m = 0.9 * m + 0.1 * curvature * x
        x -= m
    assert (abs(x) < 1e-3) == (curvature < LIMIT)
    assert (mean_square.growth(torch.tensor([curvature])) < 1) == (curvature < LIMIT)


def test_a_direction_that_few_photos_curve_is_unstable_from_2_on() -> None:
    assert mean_square.ratio(torch.tensor([1.0])) == pytest.approx(1 / LIMIT, rel=1e-6)
    alone = torch.zeros(1000)
    alone[0] = 1.0
    assert mean_square.ratio(alone) == pytest.approx(1 / 2, rel=2e-3)
    assert mean_square.ratio(-alone) == 0.0


@pytest.mark.slow
def test_needles_condition_grows_with_the_fourth_power_and_their_largest_eigenvalue_does_not() -> None:
    """Past the blur, a column's length falls with the square of the ratio, but for terms of the order of ratio^-2."""
    thin, thinner = ({row["metric"]: row for row in needles.measure(ratio)} for ratio in (1e3, 1e4))
    for metric in ("none", "Adam", "Jacobi"):
        assert thinner[metric]["condition"] / thin[metric]["condition"] == pytest.approx(1e4, rel=1e-3)
        assert thinner[metric]["largest"] == pytest.approx(thin[metric]["largest"], rel=1e-3)
    own = thinner["Jacobi, own axes"]["condition"]
    assert own == pytest.approx(thin["Jacobi, own axes"]["condition"], rel=1e-3)
    assert own < 100


@pytest.mark.slow
def test_a_small_run_of_every_part_leaves_rows_and_a_report(tmp_path: Path) -> None:
    small = [
        "--scenes",
        "synthetic",
        "--longest",
        "32",
        "--steps",
        "12",
        "--boosts",
        "8",
        "--most",
        "60",
        "--shares",
        "0.5",
    ]
    parts = ["--only", "curvature", "products", "runs"]
    assert bench.STUDY.main([*parts, *small, "--out", str(tmp_path)]) == 0
    rows = {row["part"]: row for row in bench.STUDY.rows(tmp_path)}
    assert set(rows) == {"curvature", "products", "runs"}
    assert rows["curvature"]["ratio"] > 0
    assert rows["curvature"]["error"] < rows["curvature"]["ratio"]
    assert sum(rows["curvature"]["groups"].values()) == pytest.approx(1.0)
    assert rows["runs"]["outcome"] == "trained"
    assert rows["runs"]["refused"] == 0
    text = (tmp_path / "stiffness.md").read_text()
    assert f"{rows['runs']['psnr']:.2f}" in text
    assert (tmp_path / "figures" / "stiffness.png").stat().st_size > 10_000

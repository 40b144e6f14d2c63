"""Proves `bench stability`: what its unit is, that the fused step is near it on needles and a conic is not, its report.

Not proven here: the figures themselves, which are in worker/bench/results.
"""

from __future__ import annotations

import importlib

import pytest
import torch
from _studies.functions.tolerances import U
from _studies.stability import scenes
from _studies.stability.conditioning import Problem, state
from _studies.stability.engines import CHAIN, CONIC, FUSED, engines

bench = importlib.import_module("stability")


@pytest.fixture(scope="module")
def beside() -> Problem:
    return state(scenes.rounded(scenes.needles_beside(1e4, 0)), 2)


def worst(problem: Problem, name: str) -> float:
    return max(row.get("gaussian", 0.0) for row in bench.measure(problem, engines()[name]))


def test_the_unit_of_a_colour_is_its_condition_times_the_roundoff() -> None:
    """One opaque Gaussian over all of the image: the colour is 0.5 + c Y0, and only c is rounded."""
    scene = scenes.cloud(1, width=4, height=4)
    sh = torch.zeros(1, 16, 3, dtype=torch.float64)
    sh[:, 0] = 2.0
    points = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64)
    scene = scenes.facing(
        scene, points, scene.quats, sh=sh, log_scales=torch.full((1, 3), 6.0, dtype=torch.float64),
        logit_opacities=torch.full((1,), 16.0, dtype=torch.float64),
    )  # fmt: skip
    problem = state(scene, 60)
    colour = 0.5 + 2.0 * 0.28209479177387814
    assert torch.allclose(
        problem.exact.image, torch.full((4, 4, 3), 0.999 * colour, dtype=torch.float64), rtol=1e-6
    )
    # From c by chance, 2 Y0 U in the root mean square; then half an ulp of the value itself.
    expected = 0.999 * (2.0 * 0.28209479177387814 + colour) * U
    assert torch.allclose(problem.unit.image, torch.full((4, 4, 3), expected, dtype=torch.float64), rtol=0.2)


def test_on_needles_beside_the_image_a_conic_is_lost_and_the_fused_step_is_not(beside: Problem) -> None:
    fused = [worst(beside, name) for name in engines() if name.startswith(FUSED)]
    assert max(fused) < 100
    assert worst(beside, CHAIN) > 1000
    assert worst(beside, CONIC) > 10_000


def test_an_engine_that_is_exact_has_no_error(beside: Problem) -> None:
    for row in bench.measure(beside, lambda problem: problem.exact):
        assert row["max"] == 0


def test_a_wrong_gaussian_is_seen_among_many(beside: Problem) -> None:
    from dataclasses import replace

    def wrong(problem: Problem) -> object:
        means = problem.exact.gradients["means"].clone()
        smallest = int(torch.where(means.norm(dim=1) > 0, means.norm(dim=1), torch.inf).argmin())
        means[smallest] *= 2
        return replace(problem.exact, gradients={**problem.exact.gradients, "means": means})

    (row,) = [r for r in bench.measure(beside, wrong) if r["quantity"] == "means"]
    assert row["gaussian"] > 50


def test_undecided_pixels_have_no_weight(beside: Problem) -> None:
    assert beside.undecided.any()
    assert (beside.weights[beside.undecided] == 0).all()


@pytest.mark.slow
def test_the_definition_is_that_of_50_digits() -> None:
    from _studies.stability.oracle import compare

    assert max(compare(1.0, watched=1).values()) < 1e-6

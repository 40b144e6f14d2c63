"""Proves `bench worst`: its scenes reach what they are for, it finds a planted fault, rows give back the very input.

Not proven here: the inputs found, which are in worker/bench/results and pinned in
tests/kernels/proofs/test_worst_cases.py.
"""

from __future__ import annotations

import importlib
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from _studies.stability.conditioning import Problem, Values
from _studies.stability.extremes import FAMILIES, LENS, SIDE, decided
from _studies.stability.search import (
    HYPOTHESIS,
    OPTIMISER,
    RANDOM,
    TARGETS,
    Search,
    at_random,
    by_hypothesis,
    by_optimiser,
    worst,
)

from splatmill_worker.kernels import ops

bench = importlib.import_module("worst")


def test_scenes_reach_the_image_from_far_off() -> None:
    """Needles of 10^5 pixels whose centres lie as far off draw something, for any direction and depth."""
    draw = np.random.default_rng(0)
    visible = far = 0
    for _ in range(60):
        t = draw.random(FAMILIES["one"].numbers)
        t[LENS : LENS + 2], t[LENS + 3], t[LENS + 10] = 0.5, 7 / 8, 0.9
        scene = FAMILIES["one"].make(t.tolist())
        p = ops.project(
            *(getattr(scene, k) for k in ("means", "log_scales", "quats", "logit_opacities", "sh")),
            scene.viewmat, scene.K, SIDE, SIDE, degree=3, backend="reference",
        )  # fmt: skip
        visible += bool(p.extents.any())
        far += bool((p.means2d.abs() > 1e4).any())
    assert visible >= 50
    assert far >= 30


def test_a_scene_that_rounding_decides_about_is_left_out() -> None:
    scene = FAMILIES["one"].make([0.5] * FAMILIES["one"].numbers)
    assert decided(scene)
    on_the_plane = replace(scene, means=torch.tensor([[0.0, 0.0, 0.01]], dtype=torch.float64))
    assert not decided(on_the_plane)


def lossy(problem: Problem) -> Values:
    """An engine that is exact, but for the colours of images whose Gaussians are nearly opaque: one part in 10^4."""
    harm = 1e-4 * float(torch.sigmoid(problem.scene.logit_opacities).max()) ** 8
    return replace(problem.exact, image=problem.exact.image * (1 + harm))


@pytest.mark.slow
def test_a_planted_fault_is_found_by_every_searcher() -> None:
    for searcher in (by_hypothesis, by_optimiser):
        search = Search(lossy, limit=25)
        searcher(search, "image", 60.0, 0)
        assert search.evaluations == 25
        assert search.worst["image"].ratio > 10
    search = Search(lossy, limit=12)
    progress = at_random(search, 60.0, 0)
    assert set(progress) == set(TARGETS)
    assert search.worst["image"].ratio == pytest.approx(progress["image"].points[-1][1])
    assert "means" not in search.worst, "what is exact has no worst input"


def test_a_number_that_is_none_is_the_worst_of_all() -> None:
    off = torch.tensor([[1.0], [float("nan")]])
    assert worst(off, torch.ones(2, 1)) == float("inf")


def test_a_row_has_the_very_input() -> None:
    scene = FAMILIES["two"].make(np.random.default_rng(3).random(FAMILIES["two"].numbers).tolist())
    again = bench.scene_of({"scene": bench.written(scene)})
    for part in fields(scene):
        a, b = getattr(scene, part.name), getattr(again, part.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


@pytest.mark.slow
def test_the_quick_form_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--seconds", "2", "--draws", "4", "--dry", "--out", str(tmp_path)]
    assert bench.STUDY.main([*quick, "--only", "op chain"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row.get("searcher") for row in rows} == {RANDOM, HYPOTHESIS, OPTIMISER, None}
    assert not list(tmp_path.iterdir())

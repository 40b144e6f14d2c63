"""The GPU benchmark without a GPU: it says that nothing was measured, and its arithmetic and its scenes are right.

Its figures, and that gsplat's package runs under it, can only be seen on a card.
"""

from __future__ import annotations

import math
import subprocess
import sys
from types import ModuleType

import pytest
import torch

from tests.support.paths import BENCH

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    sys.path.insert(0, str(BENCH))  # the scripts there import one another by name
    try:
        import gpu
    finally:
        sys.path.remove(str(BENCH))
    return gpu


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here, and the benchmark would run")
def test_without_a_card_it_ends_with_a_sentence_and_no_rows() -> None:
    results = BENCH / "results" / "gpu.jsonl"
    before = results.read_bytes() if results.exists() else None
    done = subprocess.run(
        [sys.executable, str(BENCH / "gpu.py")], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.startswith("Nothing was measured: ")
    assert (results.read_bytes() if results.exists() else None) == before


def test_the_scene_is_the_same_for_both_and_in_view(bench: ModuleType) -> None:
    gaussians, target = bench.cloud(500)
    again, _ = bench.cloud(500)
    assert torch.equal(gaussians.means, again.means)
    pixels = gaussians.means @ target.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert bool(((pixels >= 0) & (pixels <= torch.tensor([bench.WIDTH, bench.HEIGHT]))).all())
    theirs = bench._gsplat.parameters_of(gaussians)
    assert torch.equal(torch.cat([theirs["sh0"], theirs["shN"]], 1), gaussians.sh)
    assert torch.equal(theirs["scales"], gaussians.log_scales)


def test_gsplats_schedule_is_its_documented_default(bench: ModuleType) -> None:
    other = bench._gsplat
    assert other.position_rate(0, 30_000, 2.0) == pytest.approx(3.2e-4)
    assert other.position_rate(30_000, 30_000, 2.0) == pytest.approx(3.2e-6)
    assert other.position_rate(15_000, 30_000, 1.0) == pytest.approx(1.6e-4 * math.sqrt(0.01))
    assert [other.degree_at(step) for step in (0, 999, 1000, 2500, 29_999)] == [0, 0, 1, 2, 3]
    order = other.order(7, 20, seed=3)
    assert len(order) == 20
    assert sorted(order[:7]) == sorted(order[7:14]) == list(range(7))


def test_time_to_a_target_lies_on_the_curve(bench: ModuleType) -> None:
    curve = [{"seconds": 1.0, "psnr": 20.0}, {"seconds": 3.0, "psnr": 24.0}, {"seconds": 9.0, "psnr": 25.0}]
    assert bench.seconds_to(curve, 19.0) == 1.0
    assert bench.seconds_to(curve, 22.0) == pytest.approx(2.0)
    assert bench.seconds_to(curve, 24.5) == pytest.approx(6.0)
    assert bench.seconds_to(curve, 26.0) is None


def test_the_verdict_compares_at_equal_quality(bench: ModuleType) -> None:
    def row(engine: str, seconds: float, psnr: float) -> dict[str, object]:
        return {
            "bench": "curve",
            "scene": "fox",
            "engine": engine,
            "seconds": seconds,
            "psnr": psnr,
            "gaussians": 5,
        }

    ahead = [row("splatmill", 10, 28.0), row("splatmill", 30, 30.0), row("gsplat", 100, 29.0)]
    assert bench.verdict(ahead) == [
        "fox: gsplat's final 29.00 dB (100 s, 5 Gaussians) was reached in 20.0 s, 5.0 times sooner."
    ]
    behind = [row("splatmill", 10, 28.0), row("gsplat", 100, 29.0)]
    assert "was not reached; the best was 28.00 dB" in bench.verdict(behind)[0]

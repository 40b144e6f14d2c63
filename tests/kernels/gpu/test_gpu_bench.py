"""The GPU benchmark without a GPU: it runs dry in Triton's interpreter, and keeps the rows of parts that end early.

Its figures, and that gsplat's package and the curves run under it, can only be seen on a card.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

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


def test_it_runs_dry_and_every_part_leaves_its_rows(tmp_path: Path) -> None:
    """All parts but the curves, in the interpreter, each in a process of its own, with nothing that is timed."""
    out = tmp_path / "dry.jsonl"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(BENCH / "gpu.py"), "--dry", "--out", str(out)],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    named = ("card", "bandwidth", "proofs", "needles", "passes", "tiles", "equal")
    assert [row["bench"] for row in rows if row.get("outcome") == "done"] == list(named)
    for row in rows:
        assert row["dry"]
        assert row["commit"]
        assert row.get("ms") is None, "a time of the interpreter says nothing of a GPU"
    assert [row["passed"] for row in rows if row["bench"] == "proofs" and "passed" in row] == [True]
    for name, tile in (("passes", 16), ("tiles", 8)):
        passes = {row["pass"]: row for row in rows if row["bench"] == name and "pass" in row}
        assert {row["tile"] for row in passes.values()} == {tile}
        parts = sum(row["bytes"] for key, row in passes.items() if key not in ("whole step", "rendering"))
        assert passes["whole step"]["bytes"] == parts
    assert max(row["largest"] for row in rows if "largest" in row) < 100
    assert "| adam |" in done.stdout
    assert "cut" not in done.stdout


def test_a_part_that_is_cut_or_fails_keeps_what_it_has(bench: ModuleType, tmp_path: Path) -> None:
    def endless(_: Any) -> Iterator[dict[str, Any]]:
        yield {"kept": 1}
        time.sleep(60)

    def wrong(_: Any) -> Iterator[dict[str, Any]]:
        yield {"kept": 2}
        raise ValueError("a reason")

    out, place = tmp_path / "rows.jsonl", bench.Place("cpu", False)
    assert bench.run(bench.Part("slow", 1.0, endless), place, out, {}) == "cut after 1 s"
    assert bench.run(bench.Part("bad", 30.0, wrong), place, out, {}) == "failed"
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row.get("kept") for row in rows] == [1, None, 2, None, None]
    assert rows[3]["error"] == "ValueError: a reason"
    table = bench.table(rows)
    assert "slow: cut after 1 s" in table
    assert "bad: ValueError: a reason" in table


def test_all_parts_fit_into_ten_minutes(bench: ModuleType) -> None:
    assert sum(part.seconds for part in bench.parts([])) <= 600


def test_it_imports_nothing_that_a_bare_machine_lacks() -> None:
    """Up to the part of gsplat: neither the compiled CPU kernels nor what the worker's other rooms import."""
    program = f"""
import sys
sys.path.insert(0, {str(BENCH)!r})
import gpu, _gpu.passes, _gpu.errors, _studies.stability.conditioning, _studies.stability.scenes
import splatmill_worker.kernels.gpu.step, splatmill_worker.kernels.ops
for name in ("psutil", "PIL", "pycolmap", "redis", "splatmill", "splatmill_worker.kernels.cpu"):
    assert name not in sys.modules, name
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_the_bytes_of_a_step_follow_from_what_it_moves(bench: ModuleType) -> None:
    """Of the size that published steps are compared at: Adam alone moves 28 bytes for each of 59 parameters."""
    passes = bench.passes
    counts = passes.Counts(10**6, 10**6, 3 * 10**6, 2**20, 27_000, 256)
    floors = passes.floors(counts)
    assert floors["adam"] == 28 * 59 * 10**6 + 33 * 10**6
    assert floors["project"] == (236 + 48) * 10**6
    assert max(floors, key=lambda name: floors[name]) == "adam"
    none = passes.floors(passes.Counts(10**6, 0, 0, 2**20, 0, 256))
    assert none["adam"] < 0.05 * floors["adam"], "only visible Gaussians move"


def test_the_scene_fills_its_view(bench: ModuleType) -> None:
    view, again = (bench.compared.cloud(500, 192, 108) for _ in range(2))
    assert torch.equal(view.groups[0], again.groups[0])
    pixels = view.groups[0] @ view.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert bool(((pixels >= 0) & (pixels <= torch.tensor([192, 108]))).all())


def test_gsplats_schedule_is_its_documented_default() -> None:
    from _gpu import gsplat as other

    assert other.position_rate(0, 30_000, 2.0) == pytest.approx(3.2e-4)
    assert other.position_rate(30_000, 30_000, 2.0) == pytest.approx(3.2e-6)
    assert other.position_rate(15_000, 30_000, 1.0) == pytest.approx(1.6e-4 * math.sqrt(0.01))
    assert [other.degree_at(step) for step in (0, 999, 1000, 2500, 29_999)] == [0, 0, 1, 2, 3]
    order = other.order(7, 20, seed=3)
    assert len(order) == 20
    assert sorted(order[:7]) == sorted(order[7:14]) == list(range(7))


def test_the_verdict_compares_at_equal_quality(bench: ModuleType) -> None:
    def row(engine: str, seconds: float, psnr: float) -> dict[str, object]:
        return {
            "bench": "curves",
            "scene": "fox",
            "engine": engine,
            "seconds": seconds,
            "psnr": psnr,
            "gaussians": 5,
        }

    ahead = [row("splatmill", 10, 28.0), row("splatmill", 30, 30.0), row("gsplat", 100, 29.0)]
    assert bench.compared.verdict(ahead) == [
        "fox: gsplat's final 29.00 dB (100 s, 5 Gaussians) was reached in 20.0 s, 5.0 times sooner."
    ]
    behind = [row("splatmill", 10, 28.0), row("gsplat", 100, 29.0)]
    assert "was not reached; the best was 28.00 dB" in bench.compared.verdict(behind)[0]

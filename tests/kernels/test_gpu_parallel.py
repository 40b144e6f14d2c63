"""Two processes that train one scene over gloo do what one process does with both photos in every step.

For the autograd engine, and for the fused GPU step in Triton's interpreter. NCCL, and how
it scales, need cards.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import astuple
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from splatmill_worker.kernels import ops, reference
from splatmill_worker.splat.engine.parallel import Replicas, join, open_replica
from tests.support.kernels import replica
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

STEPS = {"reference": 3, "gpu": 2}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def together(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which two processes left what they ended with, for each engine."""
    out = tmp_path_factory.mktemp("replicas")
    runs = [f"{engine}:{steps}" for engine, steps in STEPS.items() if engine != "gpu" or find_spec("triton")]
    shared = {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "OMP_NUM_THREADS": "1",
        "TRITON_INTERPRET": "1",
    }
    running = [
        subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", replica.__name__, str(out), *runs],
            env={**os.environ, **shared, "RANK": str(rank)},
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    for process in running:
        _, complained = process.communicate(timeout=200)
        assert process.returncode == 0, complained
    return out


def alone(steps: int) -> tuple[dict[str, torch.Tensor], list[float], torch.Tensor]:
    """One process, both photos in every step, in float64: the mean of the two losses, then Adam."""
    start = replica.scene()
    params = [v.double() for v in (start.means, start.log_scales, start.quats, start.logit_opacities)]
    params += [start.sh[:, :1].double(), start.sh[:, 1:].double()]
    exp_avg, exp_avg_sq = ([torch.zeros_like(p) for p in params] for _ in range(2))
    views, losses = replica.views(), []
    scores = torch.zeros(3, start.count, dtype=torch.float64)
    for step in range(1, steps + 1):
        leaves = [p.clone().requires_grad_() for p in params]
        total = torch.zeros((), dtype=torch.float64)
        seen = []
        for viewmat, photo in views[2 * ((step - 1) % 2) :][:2]:
            means, log_scales, quats, logits = leaves[:4]
            fields = ops.project(
                means, log_scales, quats, logits, torch.cat(leaves[4:], 1), viewmat.double(), replica.K.double(),
                replica.WIDTH, replica.HEIGHT, degree=1, backend="reference",
            )  # fmt: skip
            fields.means2d.retain_grad()
            bins = reference.bin(fields, replica.WIDTH, replica.HEIGHT)
            color, _, _ = reference.composite(
                fields, bins, replica.WIDTH, replica.HEIGHT, background=replica.BACKGROUND.double()
            )
            total = total + reference.loss(color, photo)
            seen.append(fields)
        (total / 2).backward()
        half = torch.tensor([replica.WIDTH / 2, replica.HEIGHT / 2])
        for fields in seen:
            assert fields.means2d.grad is not None
            scores[0] += torch.linalg.vector_norm(
                2 * fields.means2d.grad * half, dim=1
            )  # of its own photo's loss
            scores[1] += fields.extents[:, 0] > 0
        reference.adam_(
            params,
            [x.grad if x.grad is not None else torch.zeros_like(x) for x in leaves],
            exp_avg,
            exp_avg_sq,
            astuple(replica.RATES)[:6],
            step=step,
        )
        losses.append(total.item() / 2)
    names = ("means", "log_scales", "quats", "logit_opacities")
    return {**dict(zip(names, params, strict=False)), "sh": torch.cat(params[4:], 1)}, losses, scores


@pytest.mark.parametrize("engine", ["reference", "gpu"])
def test_two_processes_take_the_step_of_one(engine: str, together: Path) -> None:
    if engine == "gpu":
        pytest.importorskip(
            "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove this here"
        )
    steps = STEPS[engine]
    first, second = (torch.load(together / f"{engine}.{rank}.pt") for rank in range(2))
    parameters, losses, scores = alone(steps)
    for name, truth in parameters.items():
        assert torch.equal(first["parameters"][name], second["parameters"][name]), (
            f"{name} differs between the processes"
        )
        # Adam moves by rate * m / sqrt(v): float32 gradients, good to 1e-4, leave at most 1e-4 of the largest
        # rate a step.
        error = (first["parameters"][name] - truth).abs().max().item()
        assert error <= 5e-2 * 1e-4 * steps, f"{name}: {error}"
    assert first["losses"] == second["losses"], "the processes would judge their health differently"
    if engine == "reference":  # the GPU step tells of earlier steps
        assert first["losses"] == pytest.approx(losses, abs=1e-6)
    assert torch.equal(first["scores"], second["scores"])
    assert (first["scores"][:2] - scores[:2]).abs().max() <= 1e-3 * scores[:2].max()


def test_shares_are_equally_long_and_cover_all_views() -> None:
    shares = [Replicas(rank, 3).share(list(range(7))) for rank in range(3)]
    assert shares == [[0, 3, 6], [1, 4, 0], [2, 5, 1]]
    with pytest.raises(ValueError, match="no views"):
        Replicas(0, 2).share([])


def test_the_cpus_separate_ops_are_refused_for_training() -> None:
    with pytest.raises(ValueError, match=r"cpu kernels.*conics.*Train in one process") as refused:
        open_replica(replica.scene(), "cpu", Replicas(0, 2))
    assert str(refused.value).endswith("or with the gpu kernels.")


def test_joining_without_torchrun_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match="torchrun"):
        join()

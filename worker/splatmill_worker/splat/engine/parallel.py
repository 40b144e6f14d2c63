"""One scene on several GPUs: every process trains on its share of the views, and all take the same averaged step.

Usually every GPU has a worker of its own, with its own scene; several GPUs on one scene finish that scene sooner.
Start one process per GPU with `torchrun`, call `join`, and give `train` the views of `share` and the engine of
`open_replica`. A step over P processes is a step over P photos, so plan P times fewer steps. The budget must be in
steps, because clocks differ between processes.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.gpu.device import interpreting
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.autograd import AutogradEngine
from splatmill_worker.splat.engine.protocol import Engine, StepResult
from splatmill_worker.splat.gaussians import Gaussians

View = TypeVar("View")


@dataclass(frozen=True)
class Replicas:
    """The processes that train one scene together.

    rank: number of this process, from 0.
    count: number of processes.
    """

    rank: int
    count: int

    def average_(self, values: Tensor) -> None:
        """Replace `values` by their mean over the processes; all get the same bits."""
        dist.all_reduce(values, op=dist.ReduceOp.SUM)
        values.div_(self.count)

    def add_(self, values: Tensor) -> None:
        """Replace `values` by their sum over the processes."""
        dist.all_reduce(values, op=dist.ReduceOp.SUM)

    def largest_(self, values: Tensor) -> None:
        """Replace `values` by their maximum over the processes."""
        dist.all_reduce(values, op=dist.ReduceOp.MAX)

    def share(self, views: Sequence[View]) -> list[View]:
        """The views of this process: every `count`-th one.

        All shares have the same length, some views occurring in two of them where the division leaves a rest, so that
        all processes draw the same random numbers and densify alike. Raises ValueError where there are no views.
        """
        if not views:
            raise ValueError("there are no views to share among the processes.")
        length = -(-len(views) // self.count)
        return [views[(self.rank + i * self.count) % len(views)] for i in range(length)]

    def check_same(self, gaussians: Gaussians) -> None:
        """Raise RuntimeError where the processes do not hold the same scene."""
        sums = torch.stack([value.double().sum() for value in gaussians])
        least, most = sums.clone(), sums.clone()
        dist.all_reduce(least, op=dist.ReduceOp.MIN)
        dist.all_reduce(most, op=dist.ReduceOp.MAX)
        counts = torch.tensor([gaussians.count, -gaussians.count], device=sums.device)
        dist.all_reduce(counts, op=dist.ReduceOp.MAX)
        if int(counts[0]) != -int(counts[1]) or not torch.equal(least, most):
            raise RuntimeError(
                f"Process {self.rank} of {self.count} holds another scene than the other processes "
                f"({gaussians.count} Gaussians here). "
                "Start all of them from the same checkpoint, with the same seed and a budget in steps."
            )


def join(backend: str | None = None) -> Replicas:
    """Join the process group that `torchrun` started: over NCCL where there are GPUs, over gloo otherwise.

    Raises RuntimeError where the environment of `torchrun` is missing.
    """
    missing = [
        name for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ
    ]
    if missing:
        raise RuntimeError(
            f"The environment lacks {', '.join(missing)}. Start the processes with torchrun --nproc-per-node N, "
            "which sets them."
        )
    if backend is None:
        backend = "nccl" if torch.cuda.is_available() else "gloo"
    if backend == "nccl":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    dist.init_process_group(backend)
    return Replicas(dist.get_rank(), dist.get_world_size())


class ReplicatedEngine(AutogradEngine):
    """The autograd engine with gradients averaged over the processes before Adam, and scores over all their views."""

    def __init__(self, gaussians: Gaussians, replicas: Replicas) -> None:
        self._replicas = replicas
        super().__init__(gaussians)

    def _score(self, projected: ops.Projected, width: int, height: int) -> None:
        total, count, extent = self.plain_sum, self.visible_count, self.max_extent
        self.plain_sum, self.visible_count = torch.zeros_like(total), torch.zeros_like(count)
        super()._score(projected, width, height)
        self._replicas.add_(self.plain_sum)
        self._replicas.add_(self.visible_count)
        self._replicas.largest_(self.max_extent)
        self.plain_sum += total
        self.visible_count += count
        self.max_extent = torch.maximum(self.max_extent, extent)

    def _adam(self, rates: Rates, step: int) -> None:
        for value in self._gaussians.parameters().values():
            if value.grad is None:
                value.grad = torch.zeros_like(value)
            self._replicas.average_(value.grad)
        super()._adam(rates, step)

    def train_photo(self, *arguments: Any, **options: Any) -> StepResult:
        """The step of the base class, with the mean loss of all processes, so that all notice a divergence together."""
        own = super().train_photo(*arguments, **options)
        loss = torch.tensor(own.loss, dtype=torch.float64)
        self._replicas.average_(loss)
        return own._replace(loss=float(loss))


def open_replica(gaussians: Gaussians, kernels: ops.Backend, replicas: Replicas) -> Engine:
    """The engine of one process, on gpu or, slowly, on reference.

    Raises ValueError for cpu, and RuntimeError where the processes were given different Gaussians.
    """
    if kernels == "cpu":
        raise ValueError(
            "Several processes cannot train one scene with the cpu kernels: averaging gradients would take their "
            "separate ops, which pass on conics of three float32 numbers, and a needle's gradient has no right digit "
            "then. Train in one process, whose fused step uses every core, or with the gpu kernels."
        )
    replicas.check_same(gaussians)
    if kernels == "gpu":
        from splatmill_worker.splat.engine.gpu import GpuEngine

        where = gaussians.means.device if interpreting() else f"cuda:{torch.cuda.current_device()}"
        return GpuEngine(gaussians, where=str(where), together=replicas)
    return ReplicatedEngine(gaussians, replicas)

"""Opens the engine that trains on a backend."""

from __future__ import annotations

from splatmill_worker.kernels import ops
from splatmill_worker.splat.engine.autograd import AutogradStep
from splatmill_worker.splat.engine.cpu import FusedStep
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians


def open_engine(gaussians: Gaussians, kernels: ops.Backend) -> Engine:
    """The engine of a backend, holding `gaussians`. The fused step where there is one, autograd elsewhere."""
    if kernels == "cpu":
        return FusedStep(gaussians)
    if kernels == "gpu":
        from splatmill_worker.splat.engine.gpu import FusedGpuStep

        return FusedGpuStep(gaussians)
    return AutogradStep(gaussians, backend=kernels)


def gaussians_of(engine: Engine) -> Gaussians:
    """A copy of what the engine holds, on the CPU."""
    return Gaussians(**engine.parameters()).map(lambda value: value.cpu())

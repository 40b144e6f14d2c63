"""Opens the engine of a backend, and copies the scene out of one."""

from __future__ import annotations

from splatmill_worker.kernels import ops
from splatmill_worker.splat.engine.autograd import AutogradEngine
from splatmill_worker.splat.engine.cpu import MOST_KEPT, CpuEngine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians


def open_engine(
    gaussians: Gaussians,
    kernels: ops.Backend,
    *,
    clustered: bool = False,
    context: Gaussians | None = None,
    most_kept: int = MOST_KEPT,
) -> Engine:
    """The engine of a backend, holding `gaussians`: the fused step on cpu and gpu, autograd on reference.

    clustered: steps leave out clusters of Gaussians that are not in view; for cpu alone.
    context: Gaussians that are rendered with the others, and that nothing moves; not for gpu.
    most_kept: as in `CpuEngine`; the others keep nothing of photos.

    Raises ValueError for what the backend does not do.
    """
    if clustered and kernels != "cpu":
        raise ValueError(f"clustered: the {kernels} engine computes all Gaussians at every step")
    if kernels == "cpu":
        return CpuEngine(gaussians, clustered=clustered, context=context, most_kept=most_kept)
    if kernels == "gpu":
        if context is not None:
            raise ValueError("context: the gpu engine moves all Gaussians")
        from splatmill_worker.splat.engine.gpu import GpuEngine

        return GpuEngine(gaussians)
    return AutogradEngine(gaussians, context=context)


def gaussians_of(engine: Engine) -> Gaussians:
    """A copy of the scene that the engine holds, on the CPU."""
    return Gaussians(**engine.parameters()).map(lambda value: value.cpu())

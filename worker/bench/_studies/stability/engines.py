"""The engines whose error is counted, each on the same float32 scene."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import torch
from _rows import build

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.records import Rates

from .conditioning import Problem, Values, by_ops

STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
FUSED, CHAIN, CONIC = "fused step", "op chain", "reference float32"
GPU = "GPU step, interpreted"

Engine = Callable[[Problem], Values]


def fused(problem: Problem) -> Values:
    """The training step of the chosen build."""
    from splatmill_worker.kernels.cpu.step import Step

    scene = problem.scene
    means, log_scales, quats, logits, sh = scene.groups(torch.float32)
    step = Step(means, log_scales, quats, logits, sh)
    weights = problem.weights.float()
    camera = scene.viewmat.float(), scene.K.float(), scene.width, scene.height
    color, _, _ = step.forward(*camera, degree=3)
    image = color.clone()
    gradients = step.gradients(weights)
    step.backward_update(weights, rates=STILL, step=1, pose_gradient=True)
    assert step.pose_gradient is not None
    return Values(image, {**gradients, "pose": step.pose_gradient})


def fused_gpu(problem: Problem) -> Values:
    """The GPU's training step in Triton's interpreter; it has no gradient to the camera.

    Triton must not have been imported before TRITON_INTERPRET=1 was set.
    """
    from splatmill_worker.kernels.gpu.step import Step

    scene = problem.scene
    step = Step(*scene.groups(torch.float32))
    color, _, _ = step.forward(scene.viewmat.float(), scene.K.float(), scene.width, scene.height, degree=3)
    gradients = step.gradients(problem.weights.float())
    return Values(color.cpu(), {name: value.cpu() for name, value in gradients.items()})


def chain(problem: Problem, backend: ops.Backend = "cpu") -> Values:
    """The separate ops of a backend in float32."""
    values, _, _ = by_ops(problem.scene, problem.weights, backend, torch.float32)
    return values


def engines() -> dict[str, Engine]:
    """Every engine that runs here, by its name in rows. The GPU's takes milliseconds for each splat of a tile."""

    def on(name: str, engine: Engine) -> Engine:
        def run(problem: Problem) -> Values:
            with build(name):
                return engine(problem)

        return run

    by_name: dict[str, Engine] = {f"{FUSED}, {name}": on(name, fused) for name in isa.supported()}
    by_name[CHAIN] = on(isa.supported()[0], chain)
    by_name[CONIC] = lambda problem: chain(problem, "reference")
    if importlib.util.find_spec("triton") is not None:
        by_name[GPU] = fused_gpu
    return by_name

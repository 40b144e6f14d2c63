"""gsplat's released package as its own default trainer uses it: what this engine is measured against.

Settings are the package's documented defaults for 30,000 steps: DefaultStrategy as it is, one Adam per group
with eps 1e-15, the position rate falling to a hundredth, one SH degree more every thousand steps. The package
has no SSIM; it is given this engine's fused loss, which favours it. It compiles its CUDA code when first
imported on a machine with a GPU.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.views import Target

STEPS = 30_000
DEGREE_EVERY = 1000
RATES = {
    "means": 1.6e-4,  # times the extent of the cameras
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}


def position_rate(step: int, steps: int, extent: float) -> float:
    """Learning rate of the means at `step` of `steps`, which falls exponentially from 1.6e-4 of the extent to 1 %."""
    return RATES["means"] * extent * math.exp(math.log(0.01) * step / steps)


def degree_at(step: int) -> int:
    """SH degree in use at a step: one more every thousand steps, as in the default trainer."""
    return min(step // DEGREE_EVERY, 3)


def parameters_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """The Gaussians under gsplat's parameter names and in its shapes."""
    full = gaussians.padded(3)
    return {
        "means": full.means,
        "scales": full.log_scales,
        "quats": full.quats,
        "opacities": full.logit_opacities,
        "sh0": full.sh[:, :1],
        "shN": full.sh[:, 1:],
    }


class GsplatTrainer:
    """A scene trained by gsplat's rasterizer and densification strategy on the GPU."""

    def __init__(self, gaussians: Gaussians, extent: float, steps: int = STEPS) -> None:
        self._package: Any = importlib.import_module("gsplat")
        self.extent, self.steps = extent, steps
        values = parameters_of(gaussians)
        self.params = torch.nn.ParameterDict(
            {k: torch.nn.Parameter(v.cuda().clone()) for k, v in values.items()}
        )
        self.optimizers = {
            name: torch.optim.Adam(
                [{"params": self.params[name], "lr": rate, "name": name}], eps=1e-15, fused=True
            )
            for name, rate in RATES.items()
        }
        self.strategy = self._package.DefaultStrategy(verbose=False)
        self.strategy.check_sanity(self.params, self.optimizers)
        self._state = self.strategy.initialize_state(scene_scale=extent)
        self._resident: dict[int, Target] = {}

    @property
    def count(self) -> int:
        return len(self.params["means"])

    def render(self, target: Target, degree: int) -> tuple[Tensor, dict[str, Any]]:
        """Colour [H, W, 3], and the information that gsplat's strategy reads."""
        here = self._on_device(target)
        p = self.params
        image, _, info = self._package.rasterization(
            means=p["means"],
            quats=p["quats"],
            scales=torch.exp(p["scales"]),
            opacities=torch.sigmoid(p["opacities"]),
            colors=torch.cat([p["sh0"], p["shN"]], 1),
            viewmats=here.viewmat[None],
            Ks=here.K[None],
            width=here.camera.width,
            height=here.camera.height,
            sh_degree=degree,
            packed=False,
        )
        return image[0], info

    def step(self, target: Target, number: int, *, densify: bool = True) -> Tensor:
        """One training step (number from 0) as the default trainer takes it; the loss stays on the device."""
        self.optimizers["means"].param_groups[0]["lr"] = position_rate(number, self.steps, self.extent)
        color, info = self.render(target, degree_at(number))
        if densify:
            self.strategy.step_pre_backward(self.params, self.optimizers, self._state, number, info)
        loss = ops.loss(color.contiguous(), self._on_device(target).rgb)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if densify:
            self.strategy.step_post_backward(
                self.params, self.optimizers, self._state, number, info, packed=False
            )
        return loss.detach()

    def _on_device(self, target: Target) -> Target:
        if id(target) not in self._resident:
            self._resident[id(target)] = target._replace(
                viewmat=target.viewmat.cuda(), K=target.K.cuda(), rgb=target.rgb.cuda()
            )
        return self._resident[id(target)]


def order(views: int, steps: int, seed: int) -> Sequence[int]:
    """The view of each step: a random permutation of all views, repeated."""
    g = torch.Generator().manual_seed(seed)
    rounds = [torch.randperm(views, generator=g) for _ in range(-(-steps // views))]
    numbers: list[int] = torch.cat(rounds)[:steps].tolist()
    return numbers

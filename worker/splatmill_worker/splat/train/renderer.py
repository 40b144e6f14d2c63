"""Views of the scene that an engine holds, rendered as they are evaluated."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Renderer, benchmark_background
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.views import Target, TrainingView


def renderer(engine: Engine, plan: Plan) -> Renderer:
    """A function that renders a target with what the engine holds at the time of the call."""

    def render(target: Target, background: Tensor) -> Tensor:
        camera = target.camera
        color, _, _ = engine.forward(
            target.viewmat,
            target.K,
            camera.width,
            camera.height,
            degree=plan.schedule.degree,
            background=background,
            antialias=plan.antialias,
        )
        return color

    return render


def render_view(engine: Engine, plan: Plan, view: TrainingView) -> Tensor:
    """Colour [H, W, 3] of one view at full training resolution, over the background that it is evaluated on."""
    return renderer(engine, plan)(view.full, evaluation_background(plan, [view]))


def evaluation_background(plan: Plan, views: Sequence[TrainingView]) -> Tensor:
    """RGB [3] behind evaluated views: that of published results, or the one colour that the plan trains over."""
    if plan.background == "random":
        return benchmark_background(views)
    return fixed_background(plan)


def fixed_background(plan: Plan) -> Tensor:
    """RGB [3] of a plan that trains over one colour."""
    return torch.full((3,), 1.0 if plan.background == "white" else 0.0)

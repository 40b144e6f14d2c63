"""Plans, engines and views for training the tiny still life."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatmill_worker.scene import Normalization, PointViews, Scene
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.schedule import Schedule
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.train import curve
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life


def plan(steps: int | None = 300, seconds: float | None = None, **changes: Any) -> Plan:
    schedule = Schedule(
        budget=Budget(steps, seconds),
        resolution=((0, 2), (60, 1)),
        degree=1,
        densify_from=60,
        densify_every=40,
        densify_until=0.7,
        expected_steps=steps or 1000,
    )
    fields: dict[str, Any] = {
        "schedule": schedule,
        "image_size": still_life.WIDTH,
        "max_gaussians": 4000,
        "densify": True,
        "initial": "points",
        "kernels": "cpu",
        "background": "black",
        "exposure": False,
        "antialias": False,
        "target_psnr": None,
        "max_memory": None,
        "stops_when_flat": False,
        "seed": 0,
    }
    return Plan(**{**fields, **changes})


def first_engine(kernels: Any = "cpu", most: int | None = None) -> Engine:
    points, colors = still_life.points()
    return open_engine(from_points(points[:most], colors[:most]), kernels)


def split() -> tuple[list[Any], list[Any]]:
    views = still_life.training_views()
    held_out = views[4::6]
    return [view for view in views if view not in held_out], held_out


def sparse_scene() -> tuple[Scene, list[TrainingView]]:
    """The still life with one point in five, seen by every view that it projects into."""
    world = Normalization.of(still_life.scene()).apply(still_life.scene())
    points, views = world.points[::5], still_life.training_views()
    rows = [
        [i for i, view in enumerate(views) if view.full.camera.project(point[None]).inside[0]]
        for point in points
    ]
    tracks = PointViews(np.cumsum([0, *map(len, rows)]), np.concatenate(rows).astype(np.int32))
    return replace(world, points=points, colors=world.colors[::5], point_views=tracks), views


@pytest.fixture(autouse=True)
def gains_of_short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains are measured from the first step on, in the files that import this."""
    monkeypatch.setattr(curve, "GAIN_FROM", 0)

"""The report of a job: error against run time, what was done and left out, and what to look at."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatmill_worker.scene import Scene
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score
from splatmill_worker.splat.machine import machine, peak_memory, versions
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report import page
from splatmill_worker.splat.report.export import Frame
from splatmill_worker.splat.report.figure import draw_curve
from splatmill_worker.splat.report.stages import Stages
from splatmill_worker.splat.train.loop import Trained, drawer, evaluation_background
from splatmill_worker.splat.views import Target, TrainingView

MISFIT = 6.0
"""dB under the median training view: such a photo does not fit the others."""

WORST = 4

NO_LPIPS = (
    "It needs the weights of an image network, which nothing installed brings; PSNR and SSIM are reported."
)


def write_report(
    out: Path,
    trained: Trained,
    plan: Plan,
    facts: Facts,
    scene: Scene,
    stages: Stages,
    written: int,
    frame: Frame,
    engine: Engine,
    views: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """Write report.json, report.png and report.html into `out`; returns the report."""
    report: dict[str, Any] = {
        "curve": [asdict(row) for row in trained.rows],
        "result": _result(trained, written),
        "seconds": {
            "sfm": 0.0,
            **stages.seconds,
            "train": trained.seconds,
            "evaluate": trained.evaluate_seconds,
        },
        "views": _view_rows(trained),
        "plan": plan.as_dict(),
        "left_out": [
            *({"what": name, "why": reason} for name, reason in plan.left_out.items()),
            *({"photo": name, "why": reason} for name, reason in scene.left_out),
            {"what": "lpips", "why": NO_LPIPS},
        ],
        "warnings": [*warnings, *_unplaced(scene), *_misfits(trained)],
        "facts": facts.as_dict(),
        "sfm": scene.facts,
        "offset": frame.offset.tolist() if frame.offset.any() else None,
        "peak_memory": peak_memory(),
        "versions": versions(plan.kernels),
        "machine": machine(),
    }
    report = plain(report)
    (out / "report.json").write_text(json.dumps(report, indent=1, allow_nan=False))
    draw_curve(out / "report.png", report["curve"], report["seconds"])
    judged = held_out or views
    score = trained.held_out or trained.on_training
    draw = drawer(engine, plan)
    backdrop = evaluation_background(plan, views)
    pictures = []
    for view_score in sorted(score.views, key=lambda row: row.psnr)[:WORST]:
        view = next(view for view in judged if view.name == view_score.name)
        rendered = draw(view.full, backdrop).clone()
        pictures.append(page.Pair(view_score, rendered, _counted(view.full, backdrop)))
    (out / "report.html").write_text(page.render(report, out / "report.png", pictures))
    return report


def _counted(target: Target, backdrop: Tensor) -> Tensor:
    """The photo uint8 [H, W, 3], grey where a mask keeps pixels out."""
    photo = target.over(backdrop)
    return photo if target.mask is None else torch.where(target.mask[..., None], photo, photo.new_tensor(128))


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: numbers that are not finite become null, arrays become lists."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _result(trained: Trained, written: int) -> dict[str, Any]:
    held = trained.held_out
    return {
        "gaussians": written,
        "steps": trained.steps,
        "stopped": trained.stopped,
        "recoveries": trained.recoveries,
        "cameras_moved_pixels": trained.cameras_moved,
        "failure": None if trained.failure is None else trained.failure.name.value,
        "psnr": None if held is None else held.psnr,
        "ssim": None if held is None else held.ssim,
        "mse": None if held is None else held.mse,
        "train_psnr": trained.on_training.psnr,
        "train_ssim": trained.on_training.ssim,
    }


def _view_rows(trained: Trained) -> list[dict[str, Any]]:
    groups: list[tuple[str, Score | None]] = [("test", trained.held_out), ("train", trained.on_training)]
    return [
        {"split": split, **asdict(view)}
        for split, score in groups
        if score is not None
        for view in score.views
    ]


def _unplaced(scene: Scene) -> list[str]:
    """One sentence for the photos that have no camera; each with its reason is among what was left out."""
    if not scene.left_out:
        return []
    names = [name for name, _ in scene.left_out]
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    return [f"{len(names)} of {len(names) + len(scene.views)} photos are not used: {shown}."]


def _misfits(trained: Trained) -> list[str]:
    ordered = sorted(trained.on_training.views, key=lambda view: view.psnr)
    if len(ordered) < 5:
        return []
    median = ordered[len(ordered) // 2].psnr
    return [
        f"{view.name} does not fit the other photos: {view.psnr:.1f} dB where the median is {median:.1f} dB."
        for view in ordered
        if view.psnr < median - MISFIT
    ]

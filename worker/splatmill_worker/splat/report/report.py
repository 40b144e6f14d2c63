"""The report of a job: error against run time, the plan with its reasons, and the photos that fit worst."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill.schema import ModelFrame
from splatmill.schema.quantities import listed
from splatmill_worker.scene import Scene
from splatmill_worker.splat.evaluate import Renderer, Score
from splatmill_worker.splat.machine import machine, peak_memory, versions
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report import disagreeing, page
from splatmill_worker.splat.report.export import Exported
from splatmill_worker.splat.report.figure import draw_curve
from splatmill_worker.splat.train.disagreement import Reason
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.train.renderer import evaluation_background
from splatmill_worker.splat.views import Target, TrainingView

MISFIT = 6.0
"""A training photo whose PSNR is more than this below the median, dB, is named in a warning."""

ADVICE: dict[Reason | None, str] = {
    "moving things": "It shows things that no other photo shows there. Look at the picture, and mask what moved.",
    "other light": "Its light differs. Set exposure to on, or leave it out if other photos show the same places.",
    "wrong camera or blur": "Most of it disagrees. Leave it out if it is blurred or has a wrong camera.",
    "not cut out": "It is opaque, and most of the others are cut out: cut it out too, or leave it out.",
    None: "Leave it out if it is blurred, shows something that moved, or has a wrong camera.",
}
"""What to do about a photo that does not fit the others, by the reason that was found."""

WORST = 4
"""Views shown beside their photos."""


@dataclass(frozen=True)
class PlannedScene:
    """The scene that was trained, and what was measured and decided before.

    scene: the cameras and points in the world that they came in, and the photos without a camera.
    facts: what was measured before training (`Facts.as_dict`).
    plan: what was decided from it.
    held_out: the views that were not trained on.
    """

    scene: Scene
    facts: Mapping[str, Any]
    plan: Plan
    held_out: Sequence[TrainingView]


_FOLDERS = re.compile(r"""(?<=['"])/(?:[^'"/]+/)+|(?<![\w.:/'"-])/(?:[^\s/'"]+/)+""")
"""The folders of an absolute path, which may hold spaces where it is quoted."""

FORMAT = 1
"""Version of the format of report.json. A report without one has version 1."""


def write_report(
    out: Path,
    planned: PlannedScene,
    trained: Trained,
    exported: Exported,
    render: Renderer,
    *,
    seconds: Mapping[str, float],
    warnings: Sequence[str],
    time_lapse: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Write report.json, report.png and report.html into the folder `out`; returns the report.

    exported: the files of the model.
    render: renders the trained scene, for the pictures of the views that it shows worst.
    seconds: wall time by stage, over all attempts; "train" and "evaluate" are added from `trained`.
    warnings: what was warned of on the way, one sentence each.
    time_lapse: the snapshots that the model keeps, in order: file, step, seconds and Gaussians of each.
    """
    plan, offset = planned.plan, exported.world.offset
    if planned.scene.facts.get("cameras_contradicted"):
        # The cameras or the lens are wrong: photos disagree for that, even if it looks like another light.
        unexplained = tuple(each._replace(reason=None) for each in trained.disagreements)
        trained = replace(trained, disagreements=unexplained)
    report: dict[str, Any] = plain(
        {
            "format": FORMAT,
            "curve": [asdict(point) for point in trained.curve],
            "result": _result(trained, exported.gaussians),
            "seconds": {
                "sfm": 0.0,
                **seconds,
                "train": trained.seconds,
                "evaluate": trained.evaluate_seconds,
            },
            "views": _view_rows(trained),
            "disagreement": disagreeing.rows(trained),
            "plan": plan.as_dict(),
            "left_out": [
                *({"what": name, "why": reason} for name, reason in plan.left_out.items()),
                *({"photo": name, "why": reason} for name, reason in planned.scene.left_out),
                *(
                    {"what": f"the held-out photo {name} beside the model", "why": reason}
                    for name, reason in exported.left_out
                ),
            ],
            "misfits": _misfits(trained),
            "warnings": warnings,
            "facts": planned.facts,
            "sfm": planned.scene.facts,
            "frame": _frame(planned.scene.frame),
            "time_lapse": time_lapse,
            "offset": offset.tolist() if offset.any() else None,
            "peak_memory": peak_memory(),
            "versions": versions(plan.kernels),
            "machine": machine(),
        }
    )
    atomic_write(out / "report.json", json.dumps(report, indent=1, allow_nan=False))
    draw_curve(out / "report.png", report["curve"], report["seconds"])
    worst = _worst_views(planned, trained, render)
    named = page.Disagreeing(disagreeing.named(trained), disagreeing.marked(trained))
    hidden = _hidden(planned, trained)
    shown = [*report["warnings"], *_unplaced(planned.scene), *(row["why"] for row in report["misfits"])]
    text = page.render(report, shown, out / "report.png", worst, named, hidden)
    atomic_write(out / "report.html", text)
    return report


def _hidden(planned: PlannedScene, trained: Trained) -> list[disagreeing.MarkedPhoto]:
    """A photo of each camera with what never moves in its photos marked."""
    views = {view.name: view for view in (*trained.views, *planned.held_out)}
    pictures = []
    for overlay in planned.scene.overlays:
        name = next((name for name in overlay.photos if name in views), None)
        if name is not None:
            picture = disagreeing.marked_photo(views[name], torch.from_numpy(overlay.region))
            pictures.append(disagreeing.MarkedPhoto(f"{name}: {overlay.caption}", picture))
    return pictures


def _worst_views(planned: PlannedScene, trained: Trained, render: Renderer) -> list[page.ViewComparison]:
    """The views with the lowest PSNR beside their photos: held-out ones where there are any."""
    views = planned.held_out or trained.views
    score = trained.held_out or trained.on_training
    background = evaluation_background(planned.plan, trained.views)
    comparisons = []
    for view_score in sorted(score.views, key=lambda row: row.psnr)[:WORST]:
        view = next(view for view in views if view.name == view_score.name)
        rendered = render(view.full, background).clone()
        comparisons.append(page.ViewComparison(view_score, rendered, _compared_part(view.full, background)))
    return comparisons


def _compared_part(target: Target, background: Tensor) -> Tensor:
    """The photo uint8 [H, W, 3], with the pixels that do not count in grey."""
    photo = target.over(background)
    return photo if target.mask is None else torch.where(target.mask[..., None], photo, photo.new_tensor(128))


def plain(value: Any) -> Any:
    """`value` in JSON's types: numbers that are not finite become None, arrays lists, and other objects their text.

    Of an absolute path, as in the message of an OSError, only the name of the file is left: reports are passed on.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    return _FOLDERS.sub("", str(value))


def _frame(frame: ModelFrame | None) -> dict[str, Any] | None:
    """The frame without the place of its origin: others who see a report may not know where photos were taken."""
    return None if frame is None else frame.model_dump(mode="json", exclude={"origin", "format"})


def _result(trained: Trained, written: int) -> dict[str, Any]:
    held = trained.held_out
    return {
        "gaussians": written,
        "steps": trained.steps,
        "stopped": trained.stopped,
        "validation": trained.validation,
        "recoveries": trained.recoveries,
        "cameras_moved_pixels": trained.cameras_moved,
        "failure": None if trained.failure is None else trained.failure.name.value,
        "psnr": None if held is None else held.psnr,
        "psnr_color_fitted": None if held is None else held.psnr_color_fitted,
        "ssim": None if held is None else held.ssim,
        "mse": None if held is None else held.mse,
        "lpips_vgg": None if held is None else held.lpips_vgg,
        "lpips_alex": None if held is None else held.lpips_alex,
        "train_psnr": trained.on_training.psnr,
        "train_psnr_color_fitted": trained.on_training.psnr_color_fitted,
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
    """A warning that counts the photos without a camera, and names some; none where all have one."""
    if not scene.left_out:
        return []
    names = [name for name, _ in scene.left_out]
    shown = listed(names, 5)
    photos = len({*names, *(view.photo for view in scene.views)})
    verb = "is" if len(names) == 1 else "are"
    return [f"{len(names)} of {photos} photos {verb} not used: {shown}. The report lists the reasons."]


def _misfits(trained: Trained) -> list[dict[str, str]]:
    """The training photos that the scene shows far worse than the others, each with a sentence."""
    ordered = sorted(trained.on_training.views, key=lambda view: view.psnr)
    if len(ordered) < 5:
        return []
    median = ordered[len(ordered) // 2].psnr
    reasons = {each.name: each.reason for each in trained.disagreements}
    return [
        {
            "photo": view.name,
            "why": f"{view.name} does not fit the other photos: its PSNR is {view.psnr:.1f} dB, the median "
            f"{median:.1f} dB. {ADVICE[reasons.get(view.name)]}",
        }
        for view in ordered
        if view.psnr < median - MISFIT
    ]

"""Short trainings on the variants, and the trained scenes that their errors are measured on."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch
from _rows import Row
from _scenes import Scene, View
from _train.child import located
from _train.run import held_out, measure
from _train.scenes import Scene as Capture

from _studies.precision.builds import using
from _studies.precision.measure import Modules
from _studies.precision.variants import Variant
from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.splat.formats import ply

KEPT = ("outcome", "psnr", "ssim", "steps", "gaussians", "cpu_seconds", "code")
"""Fields of a row of `bench train` that stay in one of these."""

VIEWS = 3
"""Held-out views that errors are measured on."""


def trained(capture: Capture, variant: Variant, modules: Modules, seed: int, options: Row, work: Path) -> Row:
    """The row of one training on a variant. options: of TrainOptions, among them `steps` and `image_size`."""
    identity = {"seed": seed, "options": capture.options | options, "revised": {}}
    with using(variant, modules[variant.name]):
        row = measure({**located(capture, work), "identity": identity, "budget": {}})
    mine = {"kind": "training", "variant": variant.name, "scene": capture.name, "seed": seed}
    return mine | {"size": options["image_size"]} | {k: row[k] for k in KEPT if k in row}


def settled(capture: Capture, options: Row, work: Path) -> Scene:
    """The scene as the shipped engine trains it, and its first held-out views. The model is kept in `work`."""
    chosen = TrainOptions.model_validate(capture.options | options)
    place = located(capture, work)
    folder = work / capture.name / f"trained, {chosen.steps} steps, {chosen.image_size} pixels"
    if not folder.is_dir():
        part = folder.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        (part / "sfm").symlink_to(place["sfm"])
        pipeline.run(Path(place["capture"]), part, chosen, _quiet, lambda: False)
        part.rename(folder)
    assert chosen.image_size is not None
    frame, views = held_out(place | {"scene": capture.name}, chosen, chosen.image_size)
    gaussians = ply.read(folder / "out" / "model.ply").gaussians
    moved = gaussians.moved(frame.scale, torch.from_numpy(frame.translation)).padded(3).parameters()
    black = torch.zeros(3)
    seen = []
    for view in views[:VIEWS]:
        target = view.full
        height, width = target.rgb.shape[:2]
        seen.append(View(target.viewmat, target.K, width, height, target.over(black)))
    names = ("means", "log_scales", "quats", "logit_opacities", "sh")
    return Scene(f"{capture.name}, trained", [moved[k] for k in names], seen)


def _quiet(*_: Any) -> None:
    """Ignore an event."""

"""What one process does, clean of what ran before: recover cameras, measure one row, or judge a peer's model."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from _rows import Row, origin, worked
from torch import Tensor

from _train import bare, few, instead, scanned
from _train.configurations import revised
from _train.outliers import judged
from _train.perceived import perceived
from _train.rows import code_version
from _train.scenes import MADE
from splatmill.schema import Switch, TrainOptions
from splatmill_worker import pipeline, sfm, synthetic
from splatmill_worker.__main__ import return_freed_memory
from splatmill_worker.errors import ModelUnreadable, Refusal, TrainingFailed
from splatmill_worker.images.load import load_views
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.holdout.split import split_views
from splatmill_worker.pipeline.job import choose_kernels
from splatmill_worker.scene import Normalization, Scene
from splatmill_worker.sfm import posed
from splatmill_worker.splat import lpips_weights
from splatmill_worker.splat.evaluate import Renderer, benchmark_background, evaluate
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lpips import Distances
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.render import render
from splatmill_worker.splat.report.report import plain
from splatmill_worker.splat.views import Target, TrainingView

NAMED = (Refusal, TrainingFailed, sfm.SfmFailed)
"""Failures that are results of a benchmark. Any other exception is a fault of the program."""

RESULT = (
    "psnr",
    "psnr_color_fitted",
    "ssim",
    "mse",
    "lpips_vgg",
    "lpips_alex",
    "train_psnr",
    "steps",
    "gaussians",
    "recoveries",
    "stopped",
)

TRUTH = "truth"
"""Folder beside the photos of a built-in scene, with the pixels that movers changed."""

PHOTOS = 40
"""Photos of the still life, as `make demo` takes them (640 x 480 pixels)."""


def _quiet(*_: object) -> None:
    """Ignore an event."""


def prepare(job: Row) -> Row:
    """The numbers of views and points of a scene; its cameras are kept in the `sfm` folder for later rows."""
    options = TrainOptions.model_validate(job["options"])
    try:
        scene = _posed(job, options)
        train, test = split_views(scene, options)
    except NAMED as failure:
        return {"failure": str(failure)}
    return {"views": len(train), "held_out": len(test), "points": len(scene.points)}


def measure(job: Row) -> Row:
    """The row of one run: the capture trained through the pipeline from an empty folder."""
    return_freed_memory()
    capture, seed, options = Path(job["capture"]), job["identity"]["seed"], asked(job)

    def revise(plan: Plan) -> Plan:
        return replace(revised(plan, job["identity"]["revised"]), seed=seed)

    row = {**job["identity"], "bench": "train", "code": code_version(), **origin()}
    otherwise = instead.applied(job["identity"].get("instead", {}))
    with otherwise, tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        workdir = _with_cameras(Path(folder), job)
        wall, cpu, machine = time.perf_counter(), time.process_time(), worked()
        try:
            outcome = pipeline.run(capture, workdir, options, _quiet, lambda: False, revise=revise)
        except NAMED as failure:
            spent = {"wall_seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
            return row | {"outcome": f"failed: {failure}", "curve": []} | spent
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        others = max(0.0, worked() - machine - cpu)
        report = json.loads((outcome.out / "report.json").read_text())
        disagreement = (
            None if outcome.trained is None else judged(capture / TRUTH, outcome.trained.disagreements)
        )
        perception = {} if outcome.trained is None else _perceived(job, options, outcome.trained.gaussians)
    result, seconds = report["result"], report["seconds"]
    recovered = report["sfm"].get("seconds", {})
    values = {
        "outcome": "trained" if result["failure"] is None else f"failed: {result['failure']}",
        **{name: result[name] for name in RESULT},
        "seconds": {**seconds, "sfm": sum(recovered.values())},
        "wall_seconds": wall,
        "cpu_seconds": cpu,
        "others_cpu_seconds": others,
        "peak_memory": report["peak_memory"],
        "backend": report["versions"]["backend"],
        "views": {"train": report["facts"]["views"], "test": report["facts"]["held_out"]},
        "size": [report["facts"]["width"], report["facts"]["height"]],
        "plan": {name: value for name, value in report["plan"].items() if name != "reasons"},
        "warnings": report["warnings"],
        "disagreement": disagreement,
        **perception,
        "curve": report["curve"],
    }  # fmt: skip
    measured: Row = rounded(values)
    return row | measured


def judge(job: Row) -> Row:
    """The scores of another trainer's model on the held-out views of the runs, at the same size."""
    path = Path(job["model"])
    options = TrainOptions.model_validate(job["options"])
    if options.image_size is None:
        return {"failure": f"{job['scene']} has no size of images, so that nothing can be judged on it."}
    try:
        gaussians = ply.read(path).gaussians
        frame, views = held_out(job, options, options.image_size)
    except (ModelUnreadable, *NAMED) as failure:
        return {"failure": str(failure)}
    if not views:
        return {"failure": f"{job['scene']} holds out no view, so that nothing can be judged on it."}
    # The training world, for the same near plane and the same float32 rounding as a run's own evaluation.
    moved = gaussians.moved(frame.scale, torch.from_numpy(frame.translation))
    draw = _drawing(moved, options)
    with torch.no_grad():
        distances = None if lpips_weights.absence() else Distances.read()
        score = evaluate(draw, views, benchmark_background(views), distances)
    judged: Row = rounded(
        {
            "kind": "peer",
            "scene": job["scene"],
            "options": job["options"],
            "name": job["name"],
            "seconds": job["seconds"],
            "psnr": score.psnr,
            "ssim": score.ssim,
            "mse": score.mse,
            "lpips_vgg": score.lpips_vgg,
            "lpips_alex": score.lpips_alex,
            **perceived(draw, views, benchmark_background(views)),
            "gaussians": gaussians.count,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "code": code_version(),
            **origin(),
        }
    )
    return judged


def held_out(job: Row, options: TrainOptions, image_size: int) -> tuple[Normalization, list[TrainingView]]:
    """The frame of the training world of a scene, and the held-out views in it."""
    scene = _posed(job, options)
    _, test = split_views(scene, options)
    frame = Normalization.of(scene)
    return frame, [TrainingView.of(photo, frame) for photo in load_views(test, image_size)]


def asked(job: Row) -> TrainOptions:
    """The options of a run: of its scene and its budget, with LPIPS wherever its weights are installed.

    Where cameras are recovered, training alone is seeded, since another seed would recover them again. Evaluation is
    clocked apart, so that a limited time is no reason to leave LPIPS out.
    """
    options = TrainOptions.model_validate(job["identity"]["options"] | job["budget"])
    changes: dict[str, Any] = {"lpips": Switch.auto if lpips_weights.absence() else Switch.on}
    if posed.find(Path(job["capture"])) is not None:
        changes["seed"] = job["identity"]["seed"]
    return options.model_copy(update=changes)


def _perceived(job: Row, options: TrainOptions, gaussians: Gaussians) -> Row:
    """What `perceived` says of a scene in the training world, on the held-out views of a run."""
    if options.image_size is None:
        return {}
    _, views = held_out(job, options, options.image_size)
    return perceived(_drawing(gaussians, options), views, benchmark_background(views))


def _drawing(gaussians: Gaussians, options: TrainOptions) -> Renderer:
    """A renderer of a scene in the training world."""
    backend = choose_kernels(options)
    shown = gaussians.map(lambda tensor: tensor.cuda()) if backend == "gpu" else gaussians

    def draw(target: Target, background: Tensor) -> Tensor:
        return render(shown, target.camera, background=background, backend=backend).color

    return draw


JOBS: dict[str, Callable[[Row], Row]] = {"prepare": prepare, "measure": measure, "judge": judge}


def main(text: str) -> int:
    """Do the job described by a JSON document, and write the result to the file that it names."""
    job = json.loads(text)
    answer = JOBS[job["do"]](job)
    path = Path(job["answer"])
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(answer)))
    os.replace(part, path)
    return 0


def _posed(job: Row, options: TrainOptions) -> Scene:
    """The posed scene of a capture. The still life is photographed first; recovered cameras are kept."""
    capture = Path(job["capture"])
    if job["made"] in bare.SCENES:
        if not capture.is_dir():
            bare.make(job["made"], capture, PHOTOS)
    elif job["made"] in scanned.SCENES:
        if not capture.is_dir():
            scanned.make(capture, PHOTOS)
    elif job["made"] in few.SCENES:
        if not capture.is_dir():
            whole = TrainOptions.model_validate(job["whole"]["options"])
            scene = _posed(job["whole"], whole)
            few.make(job["made"], capture, scene, *split_views(scene, whole))
    elif job["made"] and not (capture / "images").is_dir():
        part = capture / "images.part"
        synthetic.capture(part, PHOTOS, **MADE[job["made"]], truth=capture / TRUTH)
        part.rename(capture / "images")
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        return posed_scene(capture, _with_cameras(Path(folder), job), options, _quiet, lambda: False)


def _with_cameras(workdir: Path, job: Row) -> Path:
    """`workdir` with the recovered cameras linked where the pipeline looks for them."""
    kept = Path(job["sfm"])
    kept.mkdir(parents=True, exist_ok=True)
    (workdir / "sfm").symlink_to(kept)
    return workdir


def rounded(value: Any) -> Any:
    """`value` with its numbers rounded to six significant digits."""
    if isinstance(value, dict):
        return {name: rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value

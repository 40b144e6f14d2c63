"""Against gsplat's released package on equal Gaussians, and held-out error against training seconds on captures.

Unlike the other parts these need the worker installed with what it imports, and gsplat for its half.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from _rows import Row
from _train.spread import seconds_to
from torch import Tensor

from .scene import cloud
from .timing import Place

WIDTH, HEIGHT = 1920, 1080
MEASURED_AT = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)


def equal(place: Place) -> Iterator[Row]:
    """Step and render times of both engines on the same Gaussians, view and photo, with zero learning rates."""
    import numpy as np

    from splatmill_worker.kernels.gpu.step import Step
    from splatmill_worker.kernels.records import Rates

    still = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for n in (4,) if place.dry else (100_000, 1_000_000):
        width, height = (16, 8) if place.dry else (WIDTH, HEIGHT)
        view = cloud(n, width, height)
        common = {"gaussians": n, "width": width, "height": height}
        step = Step(*view.groups, where=place.device)
        camera = view.viewmat, view.K
        yield {
            **common, "engine": "splatmill",
            "ms": place.median_ms(partial(step.train, *camera, view.photo, degree=3, rates=still, step=1)),
            "render_ms": place.median_ms(partial(step.forward, *camera, width, height, degree=3)),
        }  # fmt: skip
        if place.dry:
            continue  # gsplat's kernels need a device
        from _gpu import gsplat
        from splatmill_worker.scene import Camera
        from splatmill_worker.splat.gaussians import Gaussians
        from splatmill_worker.splat.views import Target

        focal = float(view.K[0, 0])
        eye = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))
        target = Target(eye, view.viewmat, view.K, view.photo, None, None)
        trainer = gsplat.GsplatTrainer(Gaussians(*view.groups), 1.0)
        for optimizer in trainer.optimizers.values():
            optimizer.param_groups[0]["lr"] = 0.0
        late = 3 * gsplat.DEGREE_EVERY  # all of SH is in use
        with torch.no_grad():
            rendering = place.median_ms(partial(trainer.render, target, 3))
        yield {
            **common, "engine": "gsplat",
            "ms": place.median_ms(partial(trainer.step, target, late, densify=False)),
            "render_ms": rendering,
        }  # fmt: skip


def _drawn(trainer: Any, degree: int, target: Any, _: Tensor) -> Tensor:
    """The view that gsplat's model renders of a target at an SH degree, over black."""
    image: Tensor = trainer.render(target, degree)[0].clamp(0, 1)
    return image


def curves(captures: Sequence[Path], size: int, seconds: float, steps: int, seed: int) -> Iterator[Row]:
    """Held-out error against training seconds on each capture, of this engine first; evaluation is off the clock.

    seconds: time budget of this engine. steps: of gsplat's run.
    """
    for capture in captures:
        yield from _ours(capture, size, seconds, seed)
    for capture in captures:
        yield from _theirs(capture, size, steps, seed)


def _loaded(capture: Path, size: int) -> tuple[Any, list[Any], list[Any], Any]:
    """The scene in the training world, its training and held-out views, and its first Gaussians."""
    from splatmill_worker.images.load import load_views
    from splatmill_worker.scene import Normalization, split
    from splatmill_worker.sfm import posed
    from splatmill_worker.splat.start.points import from_points
    from splatmill_worker.splat.views import TrainingView

    poses = posed.find(capture)
    if poses is None:
        raise ValueError(f"{capture} has no cameras: give a folder with a COLMAP model or transforms.json.")
    scene = poses.load()
    frame = Normalization.of(scene)
    world = frame.apply(scene)
    chosen, kept = split(scene)
    views, held_out = ([TrainingView.of(p, frame) for p in load_views(v, size)] for v in (chosen, kept))
    return world, views, held_out, from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))


def _ours(capture: Path, size: int, seconds: float, seed: int) -> Iterator[Row]:
    from splatmill.schema import TrainOptions
    from splatmill_worker.kernels.gpu import device
    from splatmill_worker.pipeline.training import EXTENT
    from splatmill_worker.splat.engine.open import open_engine
    from splatmill_worker.splat.plan.decide import decide
    from splatmill_worker.splat.plan.facts import measure
    from splatmill_worker.splat.plan.probe import probe
    from splatmill_worker.splat.train.loop import train

    world, views, held_out, first = _loaded(capture, size)
    speed = probe(open_engine(first, "gpu"), views)
    card = device.describe()
    assert card is not None
    measured, _ = measure(world, views, len(held_out), speed)
    facts = replace(measured, memory_available=card.free_bytes)
    plan = decide(facts, TrainOptions(image_size=size, seed=seed, time_budget=seconds), "gpu")
    done = train(open_engine(first, "gpu"), views, held_out, plan, extent=EXTENT)
    common = {"scene": capture.name, "views": len(views), "held_out": len(held_out), "seed": seed}
    for point in done.curve:
        if point.psnr is not None:
            yield {**common, "engine": "splatmill", "steps": done.steps, **asdict(point)}


def _theirs(capture: Path, size: int, steps: int, seed: int) -> Iterator[Row]:
    from _gpu import gsplat
    from splatmill_worker.pipeline.training import EXTENT
    from splatmill_worker.splat.evaluate import evaluate

    _, views, held_out, first = _loaded(capture, size)
    common = {"scene": capture.name, "views": len(views), "held_out": len(held_out), "seed": seed}
    trainer = gsplat.GsplatTrainer(first, EXTENT, steps)
    for number in range(3):
        trainer.render(views[number % len(views)].full, 0)
    due = [max(1, round(share * steps)) for share in MEASURED_AT]
    seconds = 0.0
    torch.cuda.synchronize()
    started = time.perf_counter()
    for number, view in enumerate(gsplat.order(len(views), steps, seed)):
        trainer.step(views[view].full, number)
        if number + 1 == due[0]:
            torch.cuda.synchronize()
            seconds += time.perf_counter() - started
            drawn = partial(_drawn, trainer, gsplat.degree_at(number))
            with torch.no_grad():
                score = evaluate(drawn, held_out, torch.zeros(3))
            yield {
                **common, "engine": "gsplat", "steps": steps, "step": number + 1, "seconds": seconds,
                "psnr": score.psnr, "ssim": score.ssim, "gaussians": trainer.count,
            }  # fmt: skip
            due.pop(0)
            torch.cuda.synchronize()
            started = time.perf_counter()


def verdict(rows: Sequence[Row]) -> list[str]:
    """One sentence per scene: how much sooner this engine reaches the other's final held-out PSNR."""
    said = []
    for scene in sorted({row["scene"] for row in rows if row["bench"] == "curves" and "psnr" in row}):
        ours, theirs = (
            [r for r in rows if r.get("scene") == scene and r.get("engine") == name and "psnr" in r]
            for name in ("splatmill", "gsplat")
        )
        if not ours or not theirs:
            said.append(f"{scene}: only one of the two engines was measured.")
            continue
        final = theirs[-1]
        reached = seconds_to(ours, final["psnr"])
        goal = f"gsplat's final {final['psnr']:.2f} dB ({final['seconds']:.0f} s, {final['gaussians']} Gaussians)"
        if reached is None:
            said.append(
                f"{scene}: {goal} was not reached; the best was {max(r['psnr'] for r in ours):.2f} dB."
            )
        else:
            said.append(
                f"{scene}: {goal} was reached in {reached:.1f} s, {final['seconds'] / reached:.1f} times sooner."
            )
    return said

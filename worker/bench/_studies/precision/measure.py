"""What a variant costs and how far its images, gradients and moments are off."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from types import ModuleType

import torch
from _rows import Row
from _scenes import Scene
from torch import Tensor

from _studies.precision.builds import using
from _studies.precision.variants import EXACT, PLAIN, Variant
from splatmill_worker.kernels.cpu.loss import photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import BETA2, GROUPS, Rates

STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Everything is computed and written and nothing moves: each round is the same work."""

Modules = dict[str, ModuleType]


# ---- time


def timed(
    scene: Scene, variants: Sequence[Variant], modules: Modules, threads: int, rounds: int
) -> list[Row]:
    """A row for each variant: seconds of a training step, and their ratio to float32's in the same round.

    In each round the variants follow one another in turning order, each over all views, so that other work on the
    machine meets all of them alike. Seconds of a round are the mean over the views; medians over the rounds are given.
    """
    steps: dict[str, Step] = {}
    stats = [photo_stats(v.photo) for v in scene.views]
    for variant in variants:
        with using(variant, modules[variant.name]):
            steps[variant.name] = Step(*scene.groups, threads=threads)
    found: dict[str, list[Row]] = {v.name: [] for v in variants}
    for r in range(rounds + 1):
        turn = r % len(variants)
        for variant in (*variants[turn:], *variants[:turn]):
            step = steps[variant.name]
            with using(variant, modules[variant.name]):
                update = 0.0
                wall, cpu = time.perf_counter(), time.process_time()
                for view, kept in zip(scene.views, stats, strict=True):
                    step.train(view.viewmat, view.K, None, degree=3, rates=STILL, step=1000, photo_stats=kept)
                    update += step._frame.seconds[4]
                n = len(scene.views)
                wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
                spent = {"wall_ms": 1e3 * wall / n, "cpu_ms": 1e3 * cpu / n, "update_ms": 1e3 * update / n}
            if r:  # the first round fills caches and grows buffers
                found[variant.name].append(spent)
    rows = []
    for variant in variants:
        mine, plain = found[variant.name], found[PLAIN.name]
        row: Row = {"kind": "time", "variant": variant.name, "scene": scene.name, "gaussians": scene.count,
               "threads": threads, "rounds": rounds, "pairs": steps[variant.name].visibility.pairs}  # fmt: skip
        for clock in ("wall_ms", "cpu_ms", "update_ms"):
            ratios = sorted(a[clock] / b[clock] for a, b in zip(mine, plain, strict=True))
            row[clock] = statistics.median(x[clock] for x in mine)
            row[f"{clock.removesuffix('_ms')}_ratio"] = statistics.median(ratios)
            quarter = len(ratios) // 4
            row[f"{clock.removesuffix('_ms')}_quartiles"] = [ratios[quarter], ratios[-1 - quarter]]
        rows.append(row)
    return rows


# ---- error


def errors(scene: Scene, variants: Sequence[Variant], modules: Modules) -> list[Row]:
    """A row for each variant: its images and gradients against blending that leaves nothing out, and against float32.

    The gradient is that of the sum of absolute differences to the photos, with the signs that the exact images give it:
    the same linear function of the image for all.
    """
    signs: list[Tensor] = []
    exact = _drawn(scene, EXACT, modules, signs)
    plain = _drawn(scene, PLAIN, modules, signs)
    rows = []
    for variant in variants:
        got = plain if variant is PLAIN else _drawn(scene, variant, modules, signs)
        row: Row = {"kind": "error", "variant": variant.name, "scene": scene.name, "gaussians": scene.count,
               "views": len(scene.views)}  # fmt: skip
        for name, other in (("", exact), ("_float32", plain)):
            off = torch.cat([(a - b).abs().flatten() for a, b in zip(got[0], other[0], strict=True)]) * 255
            row[f"image{name}"] = float(off.mean())
            row[f"image_p999{name}"] = float(off.sort().values[math.ceil(0.999 * len(off)) - 1])
            row[f"gradient{name}"] = {
                k: float((got[1][k] - other[1][k]).norm() / other[1][k].norm()) for k in GROUPS
            }
        rows.append(row)
    return rows


def _drawn(
    scene: Scene, variant: Variant, modules: Modules, signs: list[Tensor]
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """Images of all views, and the sum of the gradients over them, float64. Fills `signs` where it is empty."""
    images: list[Tensor] = []
    total: dict[str, Tensor] = {}
    with using(variant, modules[variant.name]):
        step = Step(*scene.groups)
        for i, view in enumerate(scene.views):
            color, _, _ = step.forward(view.viewmat, view.K, view.width, view.height, degree=3)
            if len(signs) == i:
                signs.append(torch.sign(color - view.photo / 255) / color.numel())
            images.append(color.double())
            for name, gradient in step.gradients(signs[i]).items():
                total[name] = total.get(name, 0.0) + gradient.double()
    return images, total


# ---- moments


def decay(variant: Variant, modules: Modules, after: Sequence[int]) -> list[Row]:
    """How far the second moments of Gaussians that are out of view have fallen after so many steps.

    Exactly, they fall by BETA2 a step. The row has the mean over all values of their share of what they were, and the
    share of those that are exactly what they were.
    """
    generator = torch.Generator().manual_seed(0)
    count, side = 256, 32
    groups = [
        torch.randn(count, 3, generator=generator) * 0.4 + torch.tensor([0.0, 0.0, 3.0]),
        torch.full((count, 3), -2.5),
        torch.randn(count, 4, generator=generator),
        torch.zeros(count),
        0.3 * torch.randn(count, 16, 3, generator=generator),
    ]
    K = torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    towards, away = torch.eye(4), torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    photo = torch.randint(0, 256, (side, side, 3), dtype=torch.uint8, generator=generator)
    kept = photo_stats(photo)
    rows: list[Row] = []
    with using(variant, modules[variant.name]):
        step = Step(*groups, threads=1)
        for t in range(1, 21):
            step.train(towards, K, None, degree=3, rates=STILL, step=t, photo_stats=kept)
        before = step.moments()[1]
        values = before > 1e-30
        for t in range(1, max(after) + 1):
            step.train(away, K, None, degree=3, rates=STILL, step=20 + t, photo_stats=kept)
            if t in after:
                now = step.moments()[1]
                share = now[values].double() / before[values].double()
                unmoved = float((now[values] == before[values]).double().mean())
                row: Row = {"kind": "decay", "variant": variant.name, "steps": t, "exact": BETA2**t}
                rows.append(
                    row | {"share": float(share.mean()), "unmoved": unmoved, "values": int(values.sum())}
                )
    return rows

"""`bench gpu`: this engine against gsplat's released package, in one run on one card.

`python worker/bench/gpu.py CAPTURE...` (folders with photos and cameras) writes results/gpu.jsonl:
milliseconds per training step and per rendering at equal Gaussians and 1080p, and for every capture held-out
error against training seconds of both, from the same first Gaussians, photos and split. Without a usable card
it says so and measures nothing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import _gsplat
import numpy as np
import torch
from _rows import Row, write
from torch import Tensor

from splatmill.schema import TrainOptions
from splatmill_worker.images.load import load_views
from splatmill_worker.kernels.gpu import device
from splatmill_worker.pipeline import EXTENT
from splatmill_worker.scene import Camera, Normalization, split
from splatmill_worker.sfm import posed
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import evaluate
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import measure
from splatmill_worker.splat.plan.probe import ZERO_RATES, probe
from splatmill_worker.splat.render import render
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.train.loop import train
from splatmill_worker.splat.views import Target, TrainingView

WIDTH, HEIGHT = 1920, 1080
REPEATS = 30
MEASURED_AT = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)


def cloud(n: int, seed: int = 0) -> tuple[Gaussians, Target]:
    """n Gaussians that fill a 1080p view, most of them a few pixels wide, some large, and a photo of
    noise.
    """
    g = torch.Generator().manual_seed(seed)
    depth = 2.0 + 8.0 * torch.rand(n, generator=g)
    focal = 0.9 * WIDTH
    place = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([WIDTH, HEIGHT]) / focal
    spacing = (WIDTH * HEIGHT / n) ** 0.5
    size = spacing * torch.exp(0.6 * torch.randn(n, 3, generator=g)) * depth[:, None] / focal
    gaussians = Gaussians(
        torch.cat([place * depth[:, None], depth[:, None]], 1),
        torch.log(size),
        torch.randn(n, 4, generator=g),
        torch.randn(n, generator=g),
        0.2 * torch.randn(n, 16, 3, generator=g),
    )
    camera = Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, np.eye(4))
    photo = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)
    return gaussians, Target(
        camera, torch.eye(4), torch.tensor(camera.K, dtype=torch.float32), photo, None, None
    )


def median_ms(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median milliseconds on the device of `work`, after a first call that compiles and tunes."""
    for _ in range(3):
        work()
    torch.cuda.synchronize()
    taken = []
    for _ in range(repeats):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's own gap
        start.record()
        work()
        end.record()
        end.synchronize()
        taken.append(start.elapsed_time(end))
    return float(statistics.median(taken))


def seconds_to(curve: Sequence[Row], psnr: float) -> float | None:
    """Training seconds at which a curve first reaches `psnr` dB, by linear interpolation; None
    when it never does.
    """
    before: Row | None = None
    for row in curve:
        if row["psnr"] >= psnr:
            if before is None or row["psnr"] == before["psnr"]:
                return float(row["seconds"])
            share = (psnr - before["psnr"]) / (row["psnr"] - before["psnr"])
            return float(before["seconds"] + share * (row["seconds"] - before["seconds"]))
        before = row
    return None


def equal(counts: Sequence[int]) -> list[Row]:
    """Step and render times of both engines on the same Gaussians, view and photo, with zero learning rates."""
    rows: list[Row] = []
    for n in counts:
        gaussians, target = cloud(n)
        ours = open_engine(gaussians, "gpu")
        theirs = _gsplat.GsplatTrainer(gaussians, 1.0)
        for optimizer in theirs.optimizers.values():
            optimizer.param_groups[0]["lr"] = 0.0
        here = gaussians.map(lambda value: value.cuda())
        late = 3 * _gsplat.DEGREE_EVERY  # all of SH is in use

        def our_step(engine: Engine = ours, seen: Target = target) -> None:
            engine.train_photo(seen.viewmat, seen.K, seen.rgb, degree=3, rates=ZERO_RATES, step=1)

        def our_view(scene: Gaussians = here, seen: Target = target) -> None:
            with torch.no_grad():
                render(scene, seen.camera)

        def their_step(
            trainer: _gsplat.GsplatTrainer = theirs, seen: Target = target, at: int = late
        ) -> None:
            trainer.step(seen, at, densify=False)

        def their_view(trainer: _gsplat.GsplatTrainer = theirs, seen: Target = target) -> None:
            with torch.no_grad():
                trainer.render(seen, 3)

        for name, step, view in (("splatmill", our_step, our_view), ("gsplat", their_step, their_view)):
            rows.append(
                {
                    "bench": "equal",
                    "engine": name,
                    "gaussians": n,
                    "width": WIDTH,
                    "height": HEIGHT,
                    "step_ms": median_ms(step),
                    "render_ms": median_ms(view),
                }
            )
    return rows


def _drawn(trainer: _gsplat.GsplatTrainer, degree: int, target: Target, _: Tensor) -> Tensor:
    """The view that gsplat's model renders of a target at an SH degree, over black."""
    return trainer.render(target, degree)[0].clamp(0, 1)


def curves(capture: Path, size: int, steps: int, seed: int) -> list[Row]:
    """Held-out error against training seconds on one capture; evaluation is off the clock for both."""
    found = posed.find(capture)
    if found is None:
        raise SystemExit(f"{capture} has no cameras: give a folder with a COLMAP model or transforms.json.")
    scene = found.load()
    frame = Normalization.of(scene)
    world = frame.apply(scene)
    chosen, kept = split(scene)
    views, held_out = ([TrainingView.of(p, frame) for p in load_views(v, size)] for v in (chosen, kept))
    first = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))

    speed = probe(open_engine(first, "gpu"), views)
    options = TrainOptions(image_size=size, seed=seed)
    card = device.describe()
    assert card is not None
    facts = replace(measure(world, views, len(held_out), speed), memory_available=card.free_bytes)
    plan = decide(facts, options, "gpu")
    done = train(open_engine(first, "gpu"), views, held_out, plan, extent=EXTENT)
    common = {
        "bench": "curve",
        "scene": capture.name,
        "views": len(views),
        "held_out": len(held_out),
        "seed": seed,
    }
    rows: list[Row] = [
        {**common, "engine": "splatmill", "steps": done.steps, **asdict(row)}
        for row in done.curve
        if row.psnr is not None
    ]

    trainer = _gsplat.GsplatTrainer(first, EXTENT, steps)
    for number in range(3):
        trainer.render(views[number % len(views)].full, 0)
    due = [max(1, round(share * steps)) for share in MEASURED_AT]
    seconds = 0.0
    torch.cuda.synchronize()
    started = time.perf_counter()
    for number, view in enumerate(_gsplat.order(len(views), steps, seed)):
        trainer.step(views[view].full, number)
        if number + 1 == due[0]:
            torch.cuda.synchronize()
            seconds += time.perf_counter() - started
            with torch.no_grad():
                score = evaluate(
                    partial(_drawn, trainer, _gsplat.degree_at(number)),
                    held_out,
                    torch.zeros(3),
                )
            rows.append(
                {
                    **common,
                    "engine": "gsplat",
                    "steps": steps,
                    "step": number + 1,
                    "seconds": seconds,
                    "psnr": score.psnr,
                    "ssim": score.ssim,
                    "gaussians": trainer.count,
                }
            )
            due.pop(0)
            torch.cuda.synchronize()
            started = time.perf_counter()
    return rows


def verdict(rows: Sequence[Row]) -> list[str]:
    """One sentence per scene: how much sooner this engine reaches the other's final held-out PSNR."""
    said = []
    for scene in sorted({row["scene"] for row in rows if row["bench"] == "curve"}):
        ours, theirs = (
            [r for r in rows if r.get("scene") == scene and r["engine"] == name]
            for name in ("splatmill", "gsplat")
        )
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", nargs="*", type=Path, help="folders with photos and cameras")
    parser.add_argument(
        "--gaussians", type=int, nargs="+", default=[100_000, 1_000_000], help="counts to compare at"
    )
    parser.add_argument("--size", type=int, default=1600, help="longest side of the photos in pixels")
    parser.add_argument(
        "--steps", type=int, default=_gsplat.STEPS, help="of gsplat's run; its default is 30000"
    )
    parser.add_argument("--seed", type=int, default=0)
    wish = parser.parse_args()
    card = device.describe()
    if card is None:
        print(
            f"Nothing was measured: {device.absence()} This benchmark compares two GPU engines on one card."
        )
        return
    facts: Row = {
        "card": card.name,
        "capability": ".".join(map(str, card.capability)),
        "memory": card.total_bytes,
        "cuda": torch.version.cuda,
    }
    rows = equal(wish.gaussians)
    for capture in wish.captures:
        rows += curves(capture, wish.size, wish.steps, wish.seed)
    path = write("gpu", [{**row, **facts} for row in rows])
    for row in rows:
        if row["bench"] == "equal":
            taken = f"{row['step_ms']:8.2f} ms/step {row['render_ms']:8.2f} ms/view"
            print(f"{row['engine']:10} {row['gaussians']:>9} {taken}")
    print(*verdict(rows), f"{len(rows)} rows in {path}", sep="\n")


if __name__ == "__main__":
    main()

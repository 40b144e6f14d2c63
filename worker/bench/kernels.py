# ruff: noqa: E501  (rows of Markdown tables are as long as they are)
"""Error against time of rendering and differentiating, the speed table, and (`--sizes`) growth with size.

Times are medians of wall seconds over views and rounds; errors are against the float64 reference. The machine's own peaks are
probed in the same run: float32 multiply-adds by a matrix product, bandwidth by a copy that no cache holds.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

import _plot
import numpy as np
import torch
from _page import Column, of_rows, table
from _rows import HERE, Row, build, distinct, footer, of
from _scenes import Scene, cloud, fox
from _studies.study import Study
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from splatmill_worker.kernels import cpu, ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.loss import photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import GROUPS, Rates

STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Everything is computed and written, nothing moves: each round is the same work."""

THREADS = (1, 2)
MULTIPLIES = {"forward": 11, "backward": 24}
"""Vector multiplications and fused multiply-adds for a block of sixteen pixels and one Gaussian that touches it, counted
in composite_forward.cpp and composite_backward.cpp (colour alone, plain scores): what the multipliers must do at the least."""


def median_seconds(call: Callable[[], object], rounds: int) -> float:
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def probe(threads: int) -> Row:
    """Peak float32 FMA/s and bytes/s that this machine reaches on `threads` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        a = torch.randn(1536, 1536)
        fma = 1536**3 / min(_timed(lambda: a @ a) for _ in range(6))
        x = torch.zeros(64 << 20)
        y = torch.zeros_like(x)
        bandwidth = 2 * x.numel() * 4 / min(_timed(lambda: y.copy_(x)) for _ in range(4))
    finally:
        torch.set_num_threads(before)
    return {
        "bench": "kernels",
        "table": "probe",
        "threads": threads,
        "gfma_per_s": fma / 1e9,
        "gb_per_s": bandwidth / 1e9,
    }


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def named(table: str, scene: Scene, backend: str, threads: int, seconds: float) -> Row:
    """The fields that rows of times share."""
    v = scene.views[0]
    return {
        "bench": "kernels", "table": table, "scene": scene.name, "gaussians": scene.count, "width": v.width,
        "height": v.height, "backend": backend, "threads": threads, "ms": 1e3 * seconds,
    }  # fmt: skip


# ---- the speed table


def step_row(scene: Scene, build_name: str, threads: int, rounds: int) -> Row:
    """One whole training step over every view: project, bin, forward, loss, backward, sums + projection backward + Adam."""
    with build(build_name):
        step = Step(*scene.groups, threads=threads)
        stats = [photo_stats(v.photo) for v in scene.views]
        walls: list[float] = []
        phases: list[tuple[float, ...]] = []
        pairs: list[int] = []
        for r in range(rounds + 1):
            for v, kept in zip(scene.views, stats, strict=True):
                start = time.perf_counter()
                result = step.train(v.viewmat, v.K, None, degree=3, rates=STILL, step=1000, photo_stats=kept)
                wall = time.perf_counter() - start
                if r:
                    walls.append(wall)
                    phases.append((*step._frame.seconds, wall - sum(step._frame.seconds)))
                    pairs.append(result.pairs)
        blocks: list[tuple[int, int]] = []
        for v in scene.views:
            step.forward(v.viewmat, v.K, v.width, v.height, degree=3)
            blocks.append(cpu.engine.count_blocks(step._frame))
    names = ("project", "bin", "forward", "backward", "update", "loss and rest")
    middle = [statistics.median(p[i] for p in phases) for i in range(len(names))]
    return named("step", scene, f"cpu {build_name}", threads, statistics.median(walls)) | {
        "ms_by_pass": {k: 1e3 * s for k, s in zip(names, middle, strict=True)},
        "pairs": statistics.mean(pairs),
        "blocks": {k: statistics.mean(b[i] for b in blocks) for i, k in enumerate(MULTIPLIES)},
        "forward_pairs_per_s": statistics.mean(pairs) / middle[2],
        "backward_pairs_per_s": statistics.mean(pairs) / middle[3],
    }


def render_row(scene: Scene, build_name: str, threads: int, rounds: int) -> Row:
    with build(build_name):
        step = Step(*scene.groups, threads=threads)
        v = scene.views[0]
        seconds = median_seconds(lambda: step.forward(v.viewmat, v.K, v.width, v.height, degree=3), rounds)
        visibility = step.visibility
    row = named("render", scene, f"cpu {build_name}", threads, seconds)
    return row | {"pairs": visibility.pairs, "visible": visibility.visible}


def memory_row(kind: str) -> Row:
    """Peak memory of a step beyond its parameters and moments, in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--memory", kind], capture_output=True, text=True, check=True, cwd=HERE
    )
    beyond, whole, gaussians, width, height = (float(x) for x in done.stdout.split()[-5:])
    return {
        "bench": "kernels", "table": "memory", "scene": kind, "gaussians": int(gaussians), "width": int(width),
        "height": int(height), "beyond_mb": beyond, "process_mb": whole,
    }  # fmt: skip


def measure_memory(kind: str) -> None:
    scene = fox(480, 100_000) if kind == "step" else cloud(1_000_000, 1920, 1080)
    scene = scene or cloud(100_000, 270, 480)
    step = Step(*scene.groups, threads=2)
    v = scene.views[0]
    kept = photo_stats(v.photo)
    page = resource.getpagesize()

    def resident() -> float:
        with open("/proc/self/statm") as f:
            return int(f.read().split()[1]) * page / 2**20

    # The peak of loading is forgotten, so that the peak read afterwards is the step's.
    with open("/proc/self/clear_refs", "w") as f:
        f.write("5")
    before = resident()
    for _ in range(3):
        for view in scene.views[:8]:
            step.train(view.viewmat, view.K, None if view is v else view.photo, degree=3, rates=STILL, step=1000,
                       photo_stats=kept if view is v else None)  # fmt: skip
    with open("/proc/self/status") as f:
        peak = next(int(x.split()[1]) / 1024 for x in f if x.startswith("VmHWM"))
    print(peak - before, peak, scene.count, v.width, v.height)


# ---- error against time


Drawn = tuple[torch.Tensor, list[torch.Tensor]]
"""The image of one view, and the gradients to the five groups."""


def draw_and_differentiate(scene: Scene, backend: ops.Backend, dtype: torch.dtype) -> Drawn:
    """The image of one view and the gradients of a fixed weighted sum of it, by the ops one after another."""
    v = scene.views[0]
    leaves = [x.to(dtype).requires_grad_() for x in scene.groups]
    means, log_scales, quats, logit_opacities, sh = leaves
    p = ops.project(
        means, log_scales, quats, logit_opacities, sh, v.viewmat.to(dtype), v.K.to(dtype), v.width, v.height,
        degree=3, backend=backend,
    )  # fmt: skip
    bins = ops.bin(p, v.width, v.height, backend=backend)
    color, _, _ = ops.composite(p, bins, v.width, v.height, backend=backend)
    weights = (v.photo.to(dtype) / 255 - 0.5) / (v.width * v.height)
    gradients = torch.autograd.grad((color * weights).sum(), leaves)
    return color.detach(), list(gradients)


def fused(scene: Scene, step: Step) -> Drawn:
    v = scene.views[0]
    color, _, _ = step.forward(v.viewmat, v.K, v.width, v.height, degree=3)
    weights = (v.photo.float() / 255 - 0.5) / (v.width * v.height)
    return color, list(step.gradients(weights).values())


def precision_rows(scene: Scene, rounds: int) -> Iterator[Row]:
    """The float64 definition, and what each build and backend differs from it by."""

    def once(dtype: torch.dtype) -> tuple[float, Drawn]:
        start = time.perf_counter()
        got = draw_and_differentiate(scene, "reference", dtype)
        return time.perf_counter() - start, got

    def row(name: str, threads: int, seconds: float, got: Drawn) -> Row:
        largest = float(exact[1][1].norm())
        return named("precision", scene, name, threads, seconds) | {
            "image_error": float((got[0].double() - exact[0]).abs().mean()),
            # Of round Gaussians the quaternions' gradient is 0: even float64 has only its rounding.
            "gradient_errors": {
                k: float((a.double() - b).norm() / b.norm())
                for k, a, b in zip(GROUPS, got[1], exact[1], strict=True)
                if float(b.norm()) > 1e-9 * largest
            },
        }

    seconds, exact = once(torch.float64)
    yield row("reference float64", 2, seconds, exact) | {"gradient_errors": {}}
    yield row("reference float32", 2, *once(torch.float32))
    before = torch.get_num_threads()
    for name in isa.supported():
        with build(name):
            for threads in THREADS:
                torch.set_num_threads(threads)
                by_ops = partial(draw_and_differentiate, scene, "cpu", torch.float32)
                yield row(f"cpu {name}", threads, median_seconds(by_ops, rounds), by_ops())
                step = Step(*scene.groups, threads=threads)
                seconds = median_seconds(partial(fused, scene, step), rounds)
                yield row(f"cpu {name} fused", threads, seconds, fused(scene, step))
    torch.set_num_threads(before)


def precision_figure(rows: list[Row]) -> Figure:
    mine = of(rows, table="precision")
    figure, (*panels, key) = _plot.axes(3, width=5.2, height=4.8)
    markers = dict(zip(distinct(mine, "scene"), "osD^v", strict=False))
    for panel, title in zip(
        panels, ("image: mean absolute error", "gradient: worst group's error / norm"), strict=True
    ):
        for r in mine:
            color = _plot.COLORS[r["backend"].removesuffix(" fused")]
            error = (
                r["image_error"] if panel is panels[0] else max(r["gradient_errors"].values(), default=0.0)
            )
            if error == 0.0:
                panel.axvline(r["ms"], color=color, lw=0.8, ls=":", alpha=0.7)
                continue
            face = color if r["backend"].endswith("fused") else "none"
            size = 8 if r["threads"] == 2 else 5
            panel.plot(r["ms"], error, markers[r["scene"]], color=color, mfc=face, ms=size)
        _plot.name(panel, "milliseconds: render and differentiate one view", title=title, log="xy")
    dot, gray = partial(Line2D, [], [], ls="", marker="o"), "#555555"
    bases = dict.fromkeys(r["backend"].removesuffix(" fused") for r in mine)
    handles = [dot(color=_plot.COLORS[base], label=base) for base in bases]
    handles += [Line2D([], [], ls="", marker=m, color=gray, mfc="none", label=s) for s, m in markers.items()]
    handles += [
        dot(color=gray, label="filled: fused step; open: op by op"),
        dot(ms=4, color=gray, mfc="none", label="small: 1 thread; large: 2"),
    ]
    exact = _plot.COLORS["reference float64"]
    handles.append(Line2D([], [], ls=":", color=exact, label="time of the float64 definition (error 0)"))
    key.axis("off")
    key.legend(handles=handles, fontsize=9, loc="center left")
    return figure


# ---- growth with size


def size_rows(options: argparse.Namespace) -> Iterator[Row]:
    best, rounds = isa.supported()[0], options.rounds

    def row(axis: str, value: int, scene: Scene, threads: int = 2) -> Row:
        fields = step_row(scene, best, threads, rounds)
        render = sum(fields["ms_by_pass"][k] for k in ("project", "bin", "forward"))
        return fields | {"table": "sizes", "axis": axis, "value": value, "render_ms": render}

    for n in (1_000, 10_000, 100_000, 300_000, 1_000_000):
        yield row("Gaussians", n, cloud(n, 1920, 1080))
    for width in (240, 480, 960, 1920, 3840):
        height = width * 9 // 16
        yield row("pixels", width * height, cloud(100_000, width, height))
    cores = torch.get_num_threads()
    for threads in sorted({1, 2, cores, *(2**k for k in range(6) if 2**k <= cores)}):
        yield row("threads", threads, cloud(100_000, 1920, 1080), threads)
    yield memory_row("million")


def exponent(points: list[Row], key: str) -> float:
    """Slope of log time over log size in the upper half of the sweep, where fixed costs are negligible."""
    upper = sorted(points, key=lambda r: r["value"])[len(points) // 2 :] if len(points) > 3 else points
    x, y = np.log([r["value"] for r in upper]), np.log([r[key] for r in upper])
    return float(np.polyfit(x, y, 1)[0])


def size_figure(rows: list[Row]) -> Figure:
    figure, panels = _plot.axes(3, width=4.6)
    labels = {
        "Gaussians": "Gaussians, at 1920x1080",
        "pixels": "pixels, 100k Gaussians",
        "threads": "threads, 100k at 1920x1080",
    }
    for panel, (axis, label) in zip(panels, labels.items(), strict=True):
        points = of(rows, table="sizes", axis=axis)
        values = [r["value"] for r in points]
        for key, what, color in (("ms", "training step", "#1b6ca8"), ("render_ms", "render", "#e08e2b")):
            text = f"{what}, exponent {exponent(points, key):.2f}"
            panel.plot(values, [r[key] for r in points], "o-", color=color, label=text)
        panel.set_xscale("log", base=2 if axis == "threads" else 10)
        _plot.name(panel, label, "milliseconds", log="y")
        panel.legend(fontsize=8)
    return figure


# ---- tables

REACH = {
    ("step", "fox, SfM points"): ("4.6 ms, then 3.5 ms"),
    ("step", "fox, densified to 100k"): ("13 ms, then 10 ms"),
    ("render", "cloud 100,000"): ("33 ms, then 25 ms"),
    ("render", "cloud 1,000,000"): ("150 ms, then 110 ms"),
}


SIZE = "{width}x{height}"


def target(row: Row) -> str:
    reached = row["threads"] == 2 and row["backend"].endswith("avx512")
    return REACH.get((row["table"], row["scene"]), "") if reached else ""


def speed(rows: list[Row]) -> str:
    what = {"step": "training step", "render": "render"}
    columns: list[Column] = [
        ("what", lambda r: f"{what[r['table']]}, {r['scene']}, {SIZE.format_map(r)}"), ("backend", "{backend}"), ("threads", "{threads}"),
        ("ms", "{ms:.2f}"), ("target", target),
        ("by pass (ms)", lambda r: ", ".join(f"{k} {v:.2f}" for k, v in r.get("ms_by_pass", {}).items())),
    ]  # fmt: skip
    return of_rows(columns, of(rows, table="step") + of(rows, table="render"))


def pairs(rows: list[Row]) -> str:
    goal = "85 M/s / 50 M/s, then 100 / 60"
    columns: list[Column] = [
        ("composite, exact (tile, Gaussian) pairs", "{scene}, " + SIZE + ", {backend}, {threads} threads"),
        ("pairs a view", lambda r: f"{r['pairs'] / 1e3:.0f} k"), ("forward", lambda r: f"{r['forward_pairs_per_s'] / 1e6:.0f} M/s"),
        ("backward", lambda r: f"{r['backward_pairs_per_s'] / 1e6:.0f} M/s"), ("target", lambda r: goal if target(r) and "100k" in r["scene"] else ""),
    ]  # fmt: skip
    return of_rows(columns, of(rows, table="step"))


def errors(rows: list[Row]) -> str:
    def worst(row: Row) -> str:
        name, error = max(row["gradient_errors"].items(), key=lambda kv: kv[1], default=("", 0.0))
        return f"{error:.1e} {name}"

    columns: list[Column] = [
        ("scene", "{scene}, " + SIZE), ("backend", "{backend}"), ("threads", "{threads}"), ("ms", "{ms:.1f}"),
        ("image error", "{image_error:.1e}"), ("worst gradient error", worst),
    ]  # fmt: skip
    return of_rows(columns, of(rows, table="precision"))


def memory(rows: list[Row]) -> str:
    names = {"step": "training step", "million": "step at a million Gaussians"}
    return "\n".join(
        f"- Memory of the {names[m['scene']]} ({m['gaussians']:,} Gaussians, {SIZE.format_map(m)}): {m['beyond_mb']:.0f} MB beyond parameters, "
        f"moments and photos; the whole process peaked at {m['process_mb']:.0f} MB."
        for m in of(rows, table="memory")
    )


def best_build(rows: list[Row]) -> str:
    """The first that was measured."""
    backend: str = of(rows, table="step")[0]["backend"]
    return backend


def ratios(rows: list[Row]) -> str:
    """AVX2 against AVX-512, and one thread against two, on each scene; then the machine's own peaks."""
    lines = []
    best = best_build(rows)
    for scene in distinct(of(rows, table="step"), "scene"):
        mine = {(r["backend"], r["threads"]): r["ms"] for r in of(rows, table="step", scene=scene)}
        if ("cpu avx512", 2) in mine and ("cpu avx2", 2) in mine:
            share = mine["cpu avx2", 2] / mine["cpu avx512", 2]
            lines.append(
                f"- {scene}: AVX2 takes {share:.2f} times as long as AVX-512 (target 2.2, then 1.8)."
            )
        if (best, 1) in mine and (best, 2) in mine:
            share = mine[best, 1] / mine[best, 2]
            lines.append(f"- {scene}: two threads are {share:.2f} times as fast as one (target 1.9 at 100k).")
    lines += [
        f"- Probed peak on {p['threads']} thread(s): {p['gfma_per_s']:.0f} G multiply-adds a second (matrix product), {p['gb_per_s']:.0f} GB/s (copy)."
        for p in of(rows, table="probe")
    ]
    return "\n".join(lines)


def shares(rows: list[Row]) -> str:
    """The share of the measured peaks that passes reach: compositing of arithmetic, the update of memory bandwidth.

    The update reads and writes parameters and two moments, 59 floats a Gaussian.
    """
    lines = []
    for r in of(rows, table="step", backend=best_build(rows)):
        for p in of(rows, table="probe", threads=r["threads"]):
            done = [
                100 * 16e-9 * count * r["blocks"][name] / (r["ms_by_pass"][name] / 1e3) / p["gfma_per_s"]
                for name, count in MULTIPLIES.items()
            ]
            moved = r["gaussians"] * 59 * 4 * 3 * 2e-9 / (r["ms_by_pass"]["update"] / 1e3)
            # What fits into the caches does not wait for the memory.
            share = f"{100 * moved / p['gb_per_s']:.0f} %" if r["gaussians"] >= 50_000 else "in the caches"
            lines.append([r["scene"], r["threads"], *(f"{x:.0f} %" for x in done), share])
    head = "roofline: share of the probed peak|threads|forward, of the multiplications|backward, of the multiplications|update, of the bandwidth"
    return table(head, lines)


def sizes(rows: list[Row]) -> str:
    columns: list[Column] = [
        ("grows", "{axis}"), ("value", "{value:,}"), ("training step, ms", "{ms:.1f}"), ("render, ms", "{render_ms:.1f}"),
        ("pairs", lambda r: f"{r['pairs'] / 1e3:.0f} k"),
    ]  # fmt: skip
    return of_rows(columns, of(rows, table="sizes"))


def growth(rows: list[Row]) -> str:
    lines = []
    for axis in distinct(of(rows, table="sizes"), "axis"):
        points = of(rows, table="sizes", axis=axis)
        lines.append(
            f"- time grows as {axis}^{exponent(points, 'ms'):.2f} (step), ^{exponent(points, 'render_ms'):.2f} (render)."
        )
    lines += [
        f"- {m['gaussians']:,} Gaussians at {SIZE.format_map(m)}: the whole process peaked at {m['process_mb'] / 1024:.2f} GiB while "
        f"rendering and differentiating, {m['beyond_mb'] / 1024:.2f} GiB of it beyond parameters, moments and photo (bound: 4 GB)."
        for m in of(rows, table="memory")
    ]
    return "\n".join(lines)


# ---- the two studies


def steps(options: argparse.Namespace) -> Iterator[Row]:
    best = isa.supported()[0]
    captured = [scene for scene in (fox(480), fox(480, 100_000)) if scene]
    for scene in captured or [cloud(11_000, 270, 480), cloud(100_000, 270, 480)]:
        for name in isa.supported():
            for threads in THREADS if name == best else (2,):
                yield step_row(scene, name, threads, max(1, options.rounds // 2) if name == best else 1)


def renders(options: argparse.Namespace) -> Iterator[Row]:
    for n in (100_000, 1_000_000):
        scene = cloud(n, 1920, 1080)
        yield from (render_row(scene, name, 2, options.rounds) for name in isa.supported()[:2])


def precisions(options: argparse.Namespace) -> Iterator[Row]:
    for scene in (fox(480), cloud(2_000, 128, 128), cloud(20_000, 256, 256)):
        if scene is not None:
            yield from precision_rows(scene, options.rounds)


KEY = ("table", "scene", "axis", "value", "backend", "threads")
ROUNDS = {"rounds": {"type": int, "default": 5}}
STUDY = Study(
    name="kernels",
    about=__doc__,
    cases={
        "probe": lambda _: map(probe, THREADS),
        "step": steps,
        "render": renders,
        "memory": lambda _: [memory_row("step")],
        "precision": precisions,
    },
    key=KEY,
    blocks={
        "speed": speed, "pairs": pairs, "ratios": ratios, "shares": shares, "memory": memory, "errors": errors,
        "footer": footer,
    },
    figures={"kernels_precision": precision_figure},
    options=ROUNDS,
)  # fmt: skip
SIZES = Study(
    name="kernels_sizes",
    about=__doc__,
    cases={"sizes": size_rows},
    key=KEY,
    blocks={"sizes": sizes, "growth": growth, "footer": footer},
    figures={"kernels_sizes": size_figure},
    options=ROUNDS,
)


def main(argv: list[str]) -> int:
    if argv[:1] == ["--memory"]:  # a process of `memory_row`
        measure_memory(argv[1])
        return 0
    return (SIZES if "--sizes" in argv else STUDY).main([word for word in argv if word != "--sizes"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

# ruff: noqa: E501  (rows of Markdown tables are as long as they are)
"""`bench kernels`: error against time of rendering and differentiating, the speed table, and (`--sizes`) growth with size.

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
from collections.abc import Callable
from functools import partial

import _plot
import numpy as np
import torch
from _rows import HERE, Row, build, footer, read, write
from _scenes import Scene, cloud, fox
from matplotlib.lines import Line2D

from splatmill_worker.kernels import cpu, ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.loss import photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates

STILL = Rates(
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)  # everything is computed and written, nothing moves: each round is the same work
THREADS = (1, 2)
MULTIPLIES = {"forward": 11, "backward": 24}
"""Vector multiplications and fused multiply-adds for a block of sixteen pixels and one Gaussian that touches it, counted
in composite_forward.cpp and composite_backward.cpp (colour alone, plain scores): what the multipliers must do at the least."""


def median_seconds(call: Callable[[], object], rounds: int) -> float:
    call()
    found = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        found.append(time.perf_counter() - start)
    return statistics.median(found)


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
    view = scene.views[0]
    names = ("project", "bin", "forward", "backward", "update", "loss and rest")
    middle = [statistics.median(p[i] for p in phases) for i in range(len(names))]
    return {
        "bench": "kernels", "table": "step", "scene": scene.name, "gaussians": scene.count, "width": view.width,
        "height": view.height, "backend": f"cpu {build_name}", "threads": threads, "ms": 1e3 * statistics.median(walls),
        "ms_by_pass": {k: 1e3 * s for k, s in zip(names, middle, strict=True)},
        "pairs": statistics.mean(pairs),
        "blocks": {k: statistics.mean(b[i] for b in blocks) for i, k in enumerate(MULTIPLIES)},
        "forward_pairs_per_s": statistics.mean(pairs) / middle[2],
        "backward_pairs_per_s": statistics.mean(pairs) / middle[3],
    }  # fmt: skip


def render_row(scene: Scene, build_name: str, threads: int, rounds: int) -> Row:
    with build(build_name):
        step = Step(*scene.groups, threads=threads)
        v = scene.views[0]
        seconds = median_seconds(lambda: step.forward(v.viewmat, v.K, v.width, v.height, degree=3), rounds)
        seen = step.visibility
    return {
        "bench": "kernels", "table": "render", "scene": scene.name, "gaussians": scene.count, "width": v.width,
        "height": v.height, "backend": f"cpu {build_name}", "threads": threads, "ms": 1e3 * seconds, "pairs": seen.pairs,
        "visible": seen.visible,
    }  # fmt: skip


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


def draw_and_differentiate(
    scene: Scene, backend: ops.Backend, dtype: torch.dtype
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """The image of one view and the gradients of a fixed weighted sum of it, by the ops one after another."""
    v = scene.views[0]
    leaves = [x.to(dtype).requires_grad_() for x in scene.groups]
    means, log_scales, quats, logit_opacities, sh = leaves
    viewmat, K = v.viewmat.to(dtype), v.K.to(dtype)
    p = ops.project(
        means,
        log_scales,
        quats,
        logit_opacities,
        sh,
        viewmat,
        K,
        v.width,
        v.height,
        degree=3,
        backend=backend,
    )
    color, _, _ = ops.composite(
        p, ops.bin(p, v.width, v.height, backend=backend), v.width, v.height, backend=backend
    )
    weights = (v.photo.to(dtype) / 255 - 0.5) / (v.width * v.height)
    gradients = torch.autograd.grad((color * weights).sum(), leaves)
    return color.detach(), list(gradients)


def fused(scene: Scene, step: Step) -> tuple[torch.Tensor, list[torch.Tensor]]:
    v = scene.views[0]
    color, _, _ = step.forward(v.viewmat, v.K, v.width, v.height, degree=3)
    weights = (v.photo.float() / 255 - 0.5) / (v.width * v.height)
    return color, list(step.gradients(weights).values())


def precision_rows(scene: Scene, rounds: int) -> list[Row]:
    want: tuple[torch.Tensor, list[torch.Tensor]] = (torch.zeros(0), [])

    def define() -> None:
        nonlocal want
        want = draw_and_differentiate(scene, "reference", torch.float64)

    v = scene.views[0]
    rows: list[Row] = []

    def add(name: str, threads: int, seconds: float, got: tuple[torch.Tensor, list[torch.Tensor]]) -> None:
        color, gradients = got
        rows.append(
            {
                "bench": "kernels", "table": "precision", "scene": scene.name, "gaussians": scene.count, "width": v.width,
                "height": v.height, "backend": name, "threads": threads, "ms": 1e3 * seconds,
                "image_error": float((color.double() - want[0]).abs().mean()),
                "gradient_errors": {
                    k: float((a.double() - b).norm() / b.norm())
                    for k, a, b in zip(("means", "log_scales", "quats", "logit_opacities", "sh"), gradients, want[1], strict=True)
                    # Of round Gaussians the quaternions' gradient is 0: even float64 has only its rounding.
                    if float(b.norm()) > 1e-9 * float(want[1][1].norm())
                },
            }
        )  # fmt: skip

    seconds = _timed(define)
    rows.append(
        {
            "bench": "kernels", "table": "precision", "scene": scene.name, "gaussians": scene.count, "width": v.width,
            "height": v.height, "backend": "reference float64", "threads": 2, "ms": 1e3 * seconds, "image_error": 0.0,
            "gradient_errors": {},
        }
    )  # fmt: skip
    slow: list[tuple[torch.Tensor, list[torch.Tensor]]] = []
    seconds = _timed(lambda: slow.append(draw_and_differentiate(scene, "reference", torch.float32)))
    add("reference float32", 2, seconds, slow[0])
    before = torch.get_num_threads()
    for name in isa.supported():
        with build(name):
            for threads in THREADS:
                torch.set_num_threads(threads)
                got = draw_and_differentiate(scene, "cpu", torch.float32)
                add(
                    f"cpu {name}",
                    threads,
                    median_seconds(lambda: draw_and_differentiate(scene, "cpu", torch.float32), rounds),
                    got,
                )
                step = Step(*scene.groups, threads=threads)
                image, gradients = fused(scene, step)
                kept = image.clone(), gradients
                add(
                    f"cpu {name} fused",
                    threads,
                    median_seconds(partial(fused, scene, step), rounds),
                    kept,
                )
    torch.set_num_threads(before)
    return rows


def precision_figure(rows: list[Row]) -> None:
    mine = [r for r in rows if r["table"] == "precision"]
    scenes = list(dict.fromkeys(r["scene"] for r in mine))
    figure, (*panels, key) = _plot.axes(3, width=5.2, height=4.8)
    markers = dict(zip(scenes, "osD^v", strict=False))
    labelled: set[str] = set()
    for panel, title in zip(
        panels, ("image: mean absolute error", "gradient: worst group's error / norm"), strict=True
    ):
        for r in mine:
            base = r["backend"].removesuffix(" fused")
            error = (
                r["image_error"] if panel is panels[0] else max(r["gradient_errors"].values(), default=0.0)
            )
            if error == 0.0:
                panel.axvline(r["ms"], color=_plot.COLORS[base], lw=0.8, ls=":", alpha=0.7)
                continue
            face = _plot.COLORS[base] if r["backend"].endswith("fused") else "none"
            panel.plot(
                r["ms"],
                error,
                markers[r["scene"]],
                color=_plot.COLORS[base],
                mfc=face,
                ms=8 if r["threads"] == 2 else 5,
            )
            labelled.add(base)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlabel("milliseconds: render and differentiate one view")
        panel.set_title(title, fontsize=10)
    line = Line2D
    handles = [
        line([], [], ls="", marker="o", color=_plot.COLORS[b], label=b)
        for b in dict.fromkeys(r["backend"].removesuffix(" fused") for r in mine)
    ]
    key.axis("off")
    shapes = [line([], [], ls="", marker=m, color="#555555", mfc="none", label=s) for s, m in markers.items()]
    shapes += [
        line([], [], ls="", marker="o", color="#555555", label="filled: fused step; open: op by op"),
        line([], [], ls="", marker="o", ms=4, color="#555555", mfc="none", label="small: 1 thread; large: 2"),
        line(
            [],
            [],
            ls=":",
            color=_plot.COLORS["reference float64"],
            label="time of the float64 definition (error 0)",
        ),
    ]
    key.legend(handles=[*handles, *shapes], fontsize=9, loc="center left")
    _plot.save(figure, HERE / "figures" / "kernels_precision.png", footer(rows))


# ---- growth with size


def size_rows(rounds: int) -> list[Row]:
    rows = []
    best = isa.supported()[0]
    for n in (1_000, 10_000, 100_000, 300_000, 1_000_000):
        rows.append(_size_row("Gaussians", n, cloud(n, 1920, 1080), best, 2, rounds))
    for width in (240, 480, 960, 1920, 3840):
        height = width * 9 // 16
        rows.append(_size_row("pixels", width * height, cloud(100_000, width, height), best, 2, rounds))
    cores = torch.get_num_threads()
    for threads in sorted({1, 2, cores, *(2**k for k in range(6) if 2**k <= cores)}):
        rows.append(_size_row("threads", threads, cloud(100_000, 1920, 1080), best, threads, rounds))
    return rows


def _size_row(axis: str, value: int, scene: Scene, build_name: str, threads: int, rounds: int) -> Row:
    row = step_row(scene, build_name, threads, rounds)
    row.update(table="sizes", axis=axis, value=value)
    row["render_ms"] = sum(row["ms_by_pass"][k] for k in ("project", "bin", "forward"))
    return row


def exponent(points: list[Row], key: str) -> float:
    """Slope of log time over log size in the upper half of the sweep, where fixed costs are negligible."""
    upper = sorted(points, key=lambda r: r["value"])[len(points) // 2 :] if len(points) > 3 else points
    x, y = np.log([r["value"] for r in upper]), np.log([r[key] for r in upper])
    return float(np.polyfit(x, y, 1)[0])


def size_figure(rows: list[Row]) -> None:
    figure, panels = _plot.axes(3, width=4.6)
    for panel, axis in zip(panels, ("Gaussians", "pixels", "threads"), strict=True):
        points = [r for r in rows if r["table"] == "sizes" and r["axis"] == axis]
        for key, label, color in (("ms", "training step", "#1b6ca8"), ("render_ms", "render", "#e08e2b")):
            e = exponent(points, key)
            panel.plot(
                [r["value"] for r in points],
                [r[key] for r in points],
                "o-",
                color=color,
                label=f"{label}, exponent {e:.2f}",
            )
        panel.set_xscale("log", base=2 if axis == "threads" else 10)
        panel.set_yscale("log")
        panel.set_xlabel(
            {
                "Gaussians": "Gaussians, at 1920x1080",
                "pixels": "pixels, 100k Gaussians",
                "threads": "threads, 100k at 1920x1080",
            }[axis]
        )
        panel.set_ylabel("milliseconds")
        panel.legend(fontsize=8)
    _plot.save(figure, HERE / "figures" / "kernels_sizes.png", footer(rows))


# ---- tables

REACH = {
    ("step", "fox, SfM points"): ("4.6 ms, then 3.5 ms"),
    ("step", "fox, densified to 100k"): ("13 ms, then 10 ms"),
    ("render", "cloud 100,000"): ("33 ms, then 25 ms"),
    ("render", "cloud 1,000,000"): ("150 ms, then 110 ms"),
}


def table(rows: list[Row]) -> str:
    by = {
        name: [r for r in rows if r["table"] == name]
        for name in ("probe", "step", "render", "memory", "precision")
    }
    lines = [
        "# Kernels: speed, and error against time",
        "",
        "Generated by `python -m splatmill_worker bench kernels` from `results/kernels.jsonl`. SH degree 3, float32; medians.",
        "",
        "| what | backend | threads | ms | target | by pass (ms) |",
        "|---|---|---|---|---|---|",
    ]
    for r in by["step"] + by["render"]:
        passes = ", ".join(f"{k} {v:.2f}" for k, v in r.get("ms_by_pass", {}).items())
        what = "training step" if r["table"] == "step" else "render"
        goal = (
            REACH.get((r["table"], r["scene"]), "")
            if r["threads"] == 2 and r["backend"].endswith("avx512")
            else ""
        )
        lines.append(
            f"| {what}, {r['scene']}, {r['width']}x{r['height']} | {r['backend']} | {r['threads']} | {r['ms']:.2f} | {goal} | {passes} |"
        )
    lines += [
        "",
        "| composite, exact (tile, Gaussian) pairs | pairs a view | forward | backward | target |",
        "|---|---|---|---|---|",
    ]
    for r in by["step"]:
        goal = (
            "85 M/s / 50 M/s, then 100 / 60"
            if "100k" in r["scene"] and r["backend"].endswith("avx512") and r["threads"] == 2
            else ""
        )
        lines.append(
            f"| {r['scene']}, {r['width']}x{r['height']}, {r['backend']}, {r['threads']} threads | {r['pairs'] / 1e3:.0f} k | "
            f"{r['forward_pairs_per_s'] / 1e6:.0f} M/s | {r['backward_pairs_per_s'] / 1e6:.0f} M/s | {goal} |"
        )
    lines += ["", *ratios(by["step"])]
    for p in by["probe"]:
        lines.append(
            f"- Probed peak on {p['threads']} thread(s): {p['gfma_per_s']:.0f} G multiply-adds a second (matrix product), {p['gb_per_s']:.0f} GB/s (copy)."
        )
    lines += shares(by["step"], by["probe"])
    for m in by["memory"]:
        name = "training step" if m["scene"] == "step" else "step at a million Gaussians"
        lines.append(
            f"- Memory of the {name} ({m['gaussians']:,} Gaussians, {m['width']}x{m['height']}): {m['beyond_mb']:.0f} MB beyond parameters, "
            f"moments and photos; the whole process peaked at {m['process_mb']:.0f} MB."
        )
    lines += [
        "",
        "![error against time](figures/kernels_precision.png)",
        "",
        "| scene | backend | threads | ms | image error | worst gradient error |",
        "|---|---|---|---|---|---|",
    ]
    for r in by["precision"]:
        worst = max(r["gradient_errors"].items(), key=lambda kv: kv[1], default=("", 0.0))
        lines.append(
            f"| {r['scene']}, {r['width']}x{r['height']} | {r['backend']} | {r['threads']} | {r['ms']:.1f} | {r['image_error']:.1e} | {worst[1]:.1e} {worst[0]} |"
        )
    lines += ["", footer(rows), ""]
    return "\n".join(lines)


def ratios(steps: list[Row]) -> list[str]:
    """AVX2 against AVX-512, and one thread against two, on each scene."""
    found = []
    for scene in dict.fromkeys(r["scene"] for r in steps):
        mine = {(r["backend"], r["threads"]): r["ms"] for r in steps if r["scene"] == scene}
        if ("cpu avx512", 2) in mine and ("cpu avx2", 2) in mine:
            found.append(
                f"- {scene}: AVX2 takes {mine['cpu avx2', 2] / mine['cpu avx512', 2]:.2f} times as long as AVX-512 (target 2.2, then 1.8)."
            )
        best = f"cpu {isa.supported()[0]}"
        if (best, 1) in mine and (best, 2) in mine:
            found.append(
                f"- {scene}: two threads are {mine[best, 1] / mine[best, 2]:.2f} times as fast as one (target 1.9 at 100k)."
            )
    return found


def shares(steps: list[Row], probes: list[Row]) -> list[str]:
    """The share of the measured peaks that passes reach: compositing of arithmetic, the update of memory bandwidth.

    The update reads and writes parameters and two moments, 59 floats a Gaussian.
    """
    found = [
        "",
        "| roofline: share of the probed peak | threads | forward, of the multiplications | backward, of the multiplications | update, of the bandwidth |",
        "|---|---|---|---|---|",
    ]
    for r in steps:
        for p in probes:
            if p["threads"] != r["threads"] or r["backend"] != f"cpu {isa.supported()[0]}":
                continue
            done = [
                100 * 16e-9 * count * r["blocks"][name] / (r["ms_by_pass"][name] / 1e3) / p["gfma_per_s"]
                for name, count in MULTIPLIES.items()
            ]
            moved = r["gaussians"] * 59 * 4 * 3 * 2e-9 / (r["ms_by_pass"]["update"] / 1e3)
            # What fits into the caches does not wait for the memory.
            share = f"{100 * moved / p['gb_per_s']:.0f} %" if r["gaussians"] >= 50_000 else "in the caches"
            found.append(f"| {r['scene']} | {r['threads']} | {done[0]:.0f} % | {done[1]:.0f} % | {share} |")
    return [
        *found,
        "",
        f"A block of sixteen pixels takes {MULTIPLIES['forward']} vector multiplications forward and {MULTIPLIES['backward']} backward; the blocks are counted. What is",
        "missing to 100 % in compositing is latency, stores and the work of each pair; what stands near 100 % in the update is the memory itself.",
        "",
    ]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="bench kernels", description=__doc__)
    parser.add_argument(
        "--sizes", action="store_true", help="growth with Gaussians, pixels and threads instead"
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.memory:
        measure_memory(options.memory)
        return 0
    if options.sizes:
        rows = [*size_rows(options.rounds), memory_row("million")]
        write("kernels_sizes", rows)
        rows = read("kernels_sizes")
        size_figure(rows)
        (HERE / "kernels_sizes.md").write_text(size_table(rows))
        return 0
    rows = [probe(t) for t in THREADS]
    small, large = fox(480), fox(480, 100_000)
    best = isa.supported()[0]
    for scene in [s for s in (small, large) if s] or [cloud(11_000, 270, 480), cloud(100_000, 270, 480)]:
        for name in isa.supported():
            for threads in THREADS if name == best else (2,):
                rows.append(
                    step_row(scene, name, threads, max(1, options.rounds // 2) if name == best else 1)
                )
    for n in (100_000, 1_000_000):
        scene = cloud(n, 1920, 1080)
        for name in isa.supported()[:2]:
            rows.append(render_row(scene, name, 2, options.rounds))
    rows.append(memory_row("step"))
    for drawn in (small, cloud(2_000, 128, 128), cloud(20_000, 256, 256)):
        if drawn is not None:
            rows += precision_rows(drawn, options.rounds)
    write("kernels", rows)
    rows = read("kernels")
    precision_figure(rows)
    (HERE / "kernels.md").write_text(table(rows))
    return 0


def size_table(rows: list[Row]) -> str:
    lines = [
        "# Kernels: growth with size",
        "",
        "Generated by `python -m splatmill_worker bench kernels --sizes` from `results/kernels_sizes.jsonl`. Synthetic clouds.",
        "",
        "| grows | value | training step, ms | render, ms | pairs |",
        "|---|---|---|---|---|",
    ]
    sizes = [r for r in rows if r["table"] == "sizes"]
    lines += [
        f"| {r['axis']} | {r['value']:,} | {r['ms']:.1f} | {r['render_ms']:.1f} | {r['pairs'] / 1e3:.0f} k |"
        for r in sizes
    ]
    lines.append("")
    for axis in dict.fromkeys(r["axis"] for r in sizes):
        points = [r for r in sizes if r["axis"] == axis]
        lines.append(
            f"- time grows as {axis}^{exponent(points, 'ms'):.2f} (step), ^{exponent(points, 'render_ms'):.2f} (render)."
        )
    for m in (r for r in rows if r["table"] == "memory"):
        lines.append(
            f"- {m['gaussians']:,} Gaussians at {m['width']}x{m['height']}: the whole process peaked at {m['process_mb'] / 1024:.2f} GiB while "
            f"rendering and differentiating, {m['beyond_mb'] / 1024:.2f} GiB of it beyond parameters, moments and photo (bound: 4 GB)."
        )
    return "\n".join([*lines, "", "![growth](figures/kernels_sizes.png)", "", footer(rows), ""])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""`bench worst`: the inputs with the largest error in units of conditioning, looked for by hypothesis and by scipy.

    splatmill bench worst                                     # every engine, 5 CPU minutes each
    splatmill bench worst --engine "op chain" --seconds 600   # one engine; the rows of the others stay
    splatmill bench worst --replay                            # the inputs found before, measured once more
    splatmill bench worst --plot-only

One to three Gaussians and a camera (`_stability/extremes.py`), 16 x 16 pixels, gradients to everything. Expected before
the first run: that a search finds several times what random inputs show, that the fused step stays within ten units once
the rounding of the difference is counted, and that the op chain has no bound.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterable
from dataclasses import asdict, fields

import _plot
import torch
from _rows import HERE, Row, footer, lines, origin, read
from _stability.engines import CHAIN, FUSED, Engine, engines
from _stability.extremes import NEAR
from _stability.reasons import WORST
from _stability.scenes import Scene
from _stability.search import (
    FEW,
    FINAL,
    HYPOTHESIS,
    OPTIMISER,
    RANDOM,
    TARGETS,
    Progress,
    Search,
    at_random,
    by_hypothesis,
    by_optimiser,
    posed,
    ratios,
)
from matplotlib import pyplot as plt
from torch import Tensor

from splatmill_worker.kernels import ops

LIMIT = 4.0
"""Units within which an engine that trains should stay."""

SHARE = 0.25
"""Of an engine's seconds that go to random inputs, which count for every target at once."""

QUICK = 2.0
"""CPU seconds for each engine of `--quick`."""

COLORS = {RANDOM: _plot.LOSER, HYPOTHESIS: "#e08e2b", OPTIMISER: _plot.WINNER}


def searched(name: str, engine: Engine, seconds: float, number: int, draws: int = FINAL) -> Iterable[Row]:
    """Rows of one engine: by quantity the worst input; by target what each searcher had found after how many evaluations."""
    search = Search(engine)
    chance = at_random(search, SHARE * seconds, number)
    each = (1 - SHARE) * seconds / len(TARGETS) / 2
    for aim in TARGETS:
        found = {
            RANDOM: chance[aim],
            HYPOTHESIS: by_hypothesis(search, aim, each, number),
            OPTIMISER: by_optimiser(search, aim, each, number),
        }
        for searcher, progress in found.items():
            yield progressed(name, aim, searcher, progress, number)
            reached = progress.points[-1][1] if progress.points else 0.0
            print(f"{name:22} {aim:10} {searcher:45} {reached:.3g} in {progress.evaluations}", flush=True)
    for quantity, point in search.worst.items():
        row = pinned(name, quantity, point.scene(), draws)
        yield {**row, "family": point.family.name, "seed": number, "evaluations": search.evaluations}


def progressed(name: str, aim: str, searcher: str, progress: Progress, number: int) -> Row:
    return {
        "bench": "worst", "kind": "progress", "engine": name, "target": aim, "searcher": searcher,
        "seed": number, "evaluations": progress.evaluations, "points": progress.points,
    }  # fmt: skip


def pinned(name: str, quantity: str, scene: Scene, draws: int) -> Row:
    """The row of a worst input of an engine: its ratios, that of every engine on it, and all of its numbers."""
    problem, running = posed(scene, draws), engines()
    ratio = ratios(problem, running[name])[quantity]
    every = {other: ratios(problem, running[other])[quantity].explained for other in compared(running)}
    return {
        "bench": "worst", "kind": "worst", "engine": name, "quantity": quantity, "draws": draws, **asdict(ratio),
        "every": every, "scene": written(scene),
    }  # fmt: skip


def compared(running: dict[str, Engine]) -> list[str]:
    """The engines that are searched: every build of the fused step, and the op chain."""
    return [name for name in running if name.startswith(FUSED) or name == CHAIN]


def written(scene: Scene) -> Row:
    """A scene with every number as a hexadecimal float32, flat."""
    row: Row = {"width": scene.width, "height": scene.height}
    for part in fields(scene):
        value = getattr(scene, part.name)
        if isinstance(value, Tensor):
            row[part.name] = [x.hex() for x in value.flatten().tolist()]
    return row


def scene_of(row: Row) -> Scene:
    """The scene of a row of kind `worst`."""
    found = row["scene"]
    shapes = {
        "means": (-1, 3), "log_scales": (-1, 3), "quats": (-1, 4), "logit_opacities": (-1,),
        "sh": (-1, 16, 3), "viewmat": (4, 4), "K": (3, 3),
    }  # fmt: skip
    arrays = {
        k: torch.tensor([float.fromhex(x) for x in found[k]], dtype=torch.float64).reshape(shape)
        for k, shape in shapes.items()
    }
    return Scene(**arrays, width=found["width"], height=found["height"])


def store(name: str, rows: list[Row]) -> None:
    """Put the rows of an engine in the place of those that it had; what has been mended stays."""
    path = HERE / "results" / "worst.jsonl"
    kept = [row for row in lines(path) if row["engine"] != name or row["kind"] == "mended"]
    path.write_text("".join(json.dumps(row) + "\n" for row in [*kept, *rows]))


def pins() -> list[Row]:
    """The rows of inputs: the worst of each engine, and what was bad before the kernels were changed."""
    return [row for row in read("worst") if row["kind"] in ("worst", "mended")]


def replay() -> None:
    """Measure the inputs found before once more, as after a change of the kernels or of the unit, and write that."""
    rows = read("worst")
    for i, row in enumerate(rows):
        if row["kind"] == "progress":
            continue
        again = pinned(row["engine"], row["quantity"], scene_of(row), FINAL)
        print(
            f"{row['engine']:22} {row['quantity']:16} {row['explained']:.3g} then, {again['explained']:.3g} now"
        )
        rows[i] = {**row, **again, **origin(), "kind": row["kind"]}
    (HERE / "results" / "worst.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def described(scene: Scene) -> str:
    """What a scene is, in pixels."""
    with torch.no_grad():
        p = ops.project(
            scene.means, scene.log_scales, scene.quats, scene.logit_opacities, scene.sh, scene.viewmat, scene.K,
            scene.width, scene.height, degree=3, near=NEAR, backend="reference",
        )  # fmt: skip
    told = []
    for i in range(len(p.depths)):
        if not p.extents[i].any():
            told.append("culled")
            continue
        a, b, c = p.conics[i].tolist()
        root = math.sqrt(((a - c) / 2) ** 2 + b * b)
        # The smaller eigenvalue of a needle's conic from its determinant: nothing cancels.
        large = (a + c) / 2 + root
        small = (a * c - b * b) / large
        long = f"{short(1 / math.sqrt(small))}" if small > 0 else "over 1e+06"
        x, y = p.means2d[i].tolist()
        told.append(
            f"{long} x {short(1 / math.sqrt(large))} px at ({x:.0f}, {y:.0f}), depth {p.depths[i]:.2g}, opacity {p.opacities[i]:.4g}"
        )
    return "; ".join(told)


def short(x: float) -> str:
    return f"{x:.1f}" if x < 100 else f"{x:.0f}" if x < 1e4 else f"{x:.0e}"


def table(rows: list[Row]) -> str:
    found = [r for r in rows if r["kind"] == "worst"]
    names = list(dict.fromkeys(r["engine"] for r in found))
    progress = [r for r in rows if r["kind"] == "progress"]

    def largest(name: str) -> float:
        return max([0.0, *(float(r["explained"]) for r in found if r["engine"] == name)])

    fused = [n for n in names if n.startswith(FUSED)]
    head = (
        f"The worst input that the search found for the fused step is off by {short(max(largest(n) for n in fused))} units; "
        f"for the op chain by {short(largest(CHAIN))}."
    )
    text = ["# Worst inputs", "", head, "",
             "One to three Gaussians and a camera, 16 x 16 pixels. The unit is that of `stability.md`: what rounding the inputs does, with the error "
             "of 2^x and the rounding of what lies behind a splat counted in. Besides, log-scales and logits are rounded as if they were 1 at least, which "
             f"counts the rounding of exp's result. Scenes that rounding decides about (the order of depths, the near plane, what reaches the image) are left out. Columns: the worst pixel, Gaussian (by the norm of its gradient) or pose in that unit, over {found[0]['draws']} changes "
             "of the input; the same without the difference, and against the rounding of the inputs alone; the input (standard deviations in pixels, centre in pixels).", "",
             "| engine | output | units | without the difference | inputs only | input |", "|---|---|---|---|---|---|"]  # fmt: skip
    for r in found:
        text.append(
            f"| {r['engine']} | {r['quantity']} | {short(r['explained'])} | {short(r['designed'])} | {short(r['inputs'])} | {described(scene_of(r))} |"
        )
    for r in rows:
        if r["kind"] == "mended":
            text += [
                "",
                f"Mended: {r['quantity']}, {described(scene_of(r))}: {short(r['before'])} units before, {short(max(x for k, x in r['every'].items() if k != CHAIN))} now.",
            ]
    text += ["", f"## What is above {LIMIT:g} units, and why", "", WORST, "", "## What the search is worth", "",
              "Evaluations of each searcher, and the ratio that it reached; the optimisers begin with what the others found.", "",
              "| engine | target | " + " | ".join(COLORS) + " |", "|---|---|" + "---|" * len(COLORS)]  # fmt: skip
    for name in names:
        for aim in TARGETS:
            cells = []
            for searcher in COLORS:
                mine = [
                    r for r in progress if (r["engine"], r["target"], r["searcher"]) == (name, aim, searcher)
                ]
                cells.append(
                    ", ".join(
                        f"{short(r['points'][-1][1])} in {r['evaluations']}" for r in mine if r["points"]
                    )
                )
            text.append(f"| {name} | {aim} | " + " | ".join(cells) + " |")
    text += ["", "![Worst ratio against evaluations](figures/worst.png)", "",
              f"Generated by `splatmill bench worst`. {footer(rows)}", ""]  # fmt: skip
    return "\n".join(text)


def draw(rows: list[Row]) -> None:
    """For every engine and aim, the worst ratio against the number of evaluations."""
    progress = [r for r in rows if r["kind"] == "progress"]
    names = list(dict.fromkeys(r["engine"] for r in progress))
    drawn, panels = plt.subplots(
        len(names), len(TARGETS), figsize=(4.2 * len(TARGETS), 2.4 * len(names) + 0.6),
        squeeze=False, sharey="row", sharex=True,
    )  # fmt: skip
    for line, name in zip(panels, names, strict=True):
        for panel, aim in zip(line, TARGETS, strict=True):
            for r in progress:
                if (r["engine"], r["target"]) != (name, aim) or not r["points"]:
                    continue
                xs, ys = zip(*[*r["points"], (r["evaluations"], r["points"][-1][1])], strict=True)
                panel.step(xs, ys, where="post", color=COLORS[r["searcher"]], label=r["searcher"], lw=1.5)
            panel.axhspan(1e-1, LIMIT, color="#2e8b57", alpha=0.08)
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_title(aim, fontsize=9)
        line[0].set_ylim(bottom=1e-1)
        line[0].set_ylabel(f"{name}\nerror / (condition x roundoff)", fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("evaluations", fontsize=9)
    panels[0][0].legend(fontsize=7)
    _plot.save(drawn, HERE / "figures" / "worst.png", footer(rows))


def main(argv: list[str]) -> int:
    running = engines()
    names = compared(running)
    parser = argparse.ArgumentParser(
        prog="bench worst", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=300.0, help="CPU seconds for each engine")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--engine", choices=names, action="append", help="only these; the rows of others stay"
    )
    parser.add_argument("--quick", action="store_true", help="2 CPU seconds for each engine; no files")
    parser.add_argument("--replay", action="store_true", help="measure the inputs found before once more")
    parser.add_argument("--plot-only", action="store_true", help="figure and table from the rows there are")
    options = parser.parse_args(argv)
    if options.replay:
        replay()
    elif not options.plot_only:
        torch.set_num_threads(1)
        for name in options.engine or names:
            began = time.process_time()
            seconds, draws = (QUICK, FEW) if options.quick else (options.seconds, FINAL)
            found = searched(name, running[name], seconds, options.seed, draws)
            rows = [{**row, **origin()} for row in found]
            print(f"{name:22} {time.process_time() - began:.0f} CPU seconds", flush=True)
            if not options.quick:
                store(name, rows)
    if options.quick:
        return 0
    rows = read("worst")
    draw(rows)
    (HERE / "worst.md").write_text(table(rows))
    return 0


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))

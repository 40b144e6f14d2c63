# ruff: noqa: E501  (heads of tables and sentences are as long as they are)
"""The inputs with the largest error in units of conditioning, searched for by hypothesis and by scipy.

    splatmill bench worst                                     # every engine, 5 CPU minutes each
    splatmill bench worst --only "op chain" --seconds 600     # one engine; the rows of the others stay
    splatmill bench worst --seconds 2 --draws 4 --dry         # printed only
    splatmill bench worst --replay                            # the stored inputs, measured once more

One to three Gaussians and a camera (`_studies/stability/extremes.py`), 16 x 16 pixels, gradients to everything.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import asdict, fields
from functools import partial

import _plot
import torch
from _page import Column, of_rows, table
from _rows import Row, distinct, of
from _studies.stability.engines import CHAIN, FUSED, engines
from _studies.stability.extremes import projected
from _studies.stability.scenes import Scene
from _studies.stability.search import (
    FINAL,
    HYPOTHESIS,
    OPTIMISER,
    RANDOM,
    TARGETS,
    Search,
    at_random,
    by_hypothesis,
    by_optimiser,
    posed,
    ratios,
)
from _studies.study import Study, generated
from matplotlib.figure import Figure
from torch import Tensor

LIMIT = 4.0
"""Units within which an engine that trains should stay."""

SHARE = 0.25
"""Of an engine's seconds that go to random inputs, which count for every target at once."""

COLORS = {RANDOM: _plot.LOSER, HYPOTHESIS: "#e08e2b", OPTIMISER: _plot.WINNER}

COMPARED = [name for name in engines() if name.startswith(FUSED) or name == CHAIN]
"""The engines that are searched: every build of the fused step, and the op chain."""


def searched(name: str, options: argparse.Namespace) -> Iterator[Row]:
    """Rows of one engine: by quantity the worst input; by target what each searcher reached after how many evaluations."""
    if options.replay:
        for row in of(options.known, engine=name):
            if row["kind"] != "progress":
                yield {
                    **row,
                    **pinned(name, row["quantity"], scene_of(row), options.draws),
                    "kind": row["kind"],
                }
        return
    torch.set_num_threads(1)
    search, seed = Search(engines()[name]), options.seed
    chance = at_random(search, SHARE * options.seconds, seed)
    each = (1 - SHARE) * options.seconds / len(TARGETS) / 2
    for aim in TARGETS:
        by_searcher = {
            RANDOM: chance[aim],
            HYPOTHESIS: by_hypothesis(search, aim, each, seed),
            OPTIMISER: by_optimiser(search, aim, each, seed),
        }
        for searcher, progress in by_searcher.items():
            yield {
                "bench": "worst", "kind": "progress", "engine": name, "target": aim, "searcher": searcher,
                "seed": seed, "evaluations": progress.evaluations, "points": progress.points,
            }  # fmt: skip
    for quantity, point in search.worst.items():
        row = pinned(name, quantity, point.scene(), options.draws)
        yield {**row, "family": point.family.name, "seed": seed, "evaluations": search.evaluations}


def pinned(name: str, quantity: str, scene: Scene, draws: int) -> Row:
    """The row of a worst input of an engine: its ratios, that of every engine on it, and all of its numbers."""
    problem, running = posed(scene, draws), engines()
    ratio = ratios(problem, running[name])[quantity]
    every = {other: ratios(problem, running[other])[quantity].explained for other in COMPARED}
    return {
        "bench": "worst", "kind": "worst", "engine": name, "quantity": quantity, "draws": draws, **asdict(ratio),
        "every": every, "scene": written(scene),
    }  # fmt: skip


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
    shapes = {
        "means": (-1, 3), "log_scales": (-1, 3), "quats": (-1, 4), "logit_opacities": (-1,),
        "sh": (-1, 16, 3), "viewmat": (4, 4), "K": (3, 3),
    }  # fmt: skip
    arrays = {
        k: torch.tensor([float.fromhex(x) for x in row["scene"][k]], dtype=torch.float64).reshape(shape)
        for k, shape in shapes.items()
    }
    return Scene(**arrays, width=row["scene"]["width"], height=row["scene"]["height"])


def pins() -> list[Row]:
    """The rows of inputs: the worst of each engine, and what was bad before the kernels were changed."""
    return [row for row in STUDY.rows() if row["kind"] in ("worst", "mended")]


# ---- blocks of the page


def described(row: Row) -> str:
    """What the scene of a row is, in pixels."""
    p = projected(scene_of(row))
    words = []
    for i in range(len(p.depths)):
        if not p.extents[i].any():
            words.append("culled")
            continue
        a, b, c = p.conics[i].tolist()
        root = math.sqrt(((a - c) / 2) ** 2 + b * b)
        # The smaller eigenvalue of a needle's conic from its determinant: nothing cancels.
        large = (a + c) / 2 + root
        small = (a * c - b * b) / large
        long = f"{short(1 / math.sqrt(small))}" if small > 0 else "over 1e+06"
        x, y = p.means2d[i].tolist()
        words.append(
            f"{long} x {short(1 / math.sqrt(large))} px at ({x:.0f}, {y:.0f}), depth {p.depths[i]:.2g}, opacity {p.opacities[i]:.4g}"
        )
    return "; ".join(words)


def short(x: float) -> str:
    return f"{x:.1f}" if x < 100 else f"{x:.0f}" if x < 1e4 else f"{x:.0e}"


def outcome(rows: list[Row]) -> str:
    def largest(part: str) -> str:
        return short(
            max(0.0, *(r["explained"] for r in of(rows, kind="worst") if r["engine"].startswith(part)))
        )

    return (
        f"The worst input that the search found for the fused step is off by {largest(FUSED)} units; "
        f"for the op chain by {largest(CHAIN)}."
    )


def inputs(rows: list[Row]) -> str:
    columns: list[Column] = [
        ("engine", "{engine}"), ("output", "{quantity}"), ("units", lambda row: short(row["explained"])),
        ("without the difference", lambda row: short(row["designed"])), ("inputs only", lambda row: short(row["inputs"])),
        ("input", described),
    ]  # fmt: skip
    return of_rows(columns, of(rows, kind="worst"))


def mended(rows: list[Row]) -> str:
    return "\n\n".join(
        f"Mended: {r['quantity']}, {described(r)}: {short(r['before'])} units before, {short(max(x for k, x in r['every'].items() if k != CHAIN))} now."
        for r in of(rows, kind="mended")
    )


def searchers(rows: list[Row]) -> str:
    lines = []
    for name in distinct(of(rows, kind="worst"), "engine"):
        for aim in TARGETS:
            cells = [
                ", ".join(
                    f"{short(r['points'][-1][1])} in {r['evaluations']}"
                    for r in of(rows, kind="progress", engine=name, target=aim, searcher=searcher)
                    if r["points"]
                )
                for searcher in COLORS
            ]
            lines.append([name, aim, *cells])
    return table("|".join(["engine", "target", *COLORS]), lines)


def draw(rows: list[Row]) -> Figure:
    """For every engine and aim, the worst ratio against the number of evaluations."""
    progress = of(rows, kind="progress")
    names = distinct(progress, "engine")
    height = 2.4 * len(names) + 0.6
    figure, panels = _plot.axes(len(TARGETS), len(names), width=4.2, height=height, sharex=True, sharey="row")
    for panel, (name, aim) in zip(panels, ((n, a) for n in names for a in TARGETS), strict=True):
        for r in of(progress, engine=name, target=aim):
            if r["points"]:
                xs, ys = zip(*[*r["points"], (r["evaluations"], r["points"][-1][1])], strict=True)
                panel.step(xs, ys, where="post", color=COLORS[r["searcher"]], label=r["searcher"], lw=1.5)
        panel.axhspan(1e-1, LIMIT, color="#2e8b57", alpha=0.08)
        _plot.name(panel, title=aim, log="xy", size=9)
    for name, panel in zip(names, panels[:: len(TARGETS)], strict=True):
        panel.set_ylim(bottom=1e-1)
        _plot.name(panel, y=f"{name}\nerror / (condition x roundoff)", size=8)
    for panel in panels[-len(TARGETS) :]:
        _plot.name(panel, "evaluations", size=9)
    panels[0].legend(fontsize=7)
    return figure


STUDY = Study(
    name="worst",
    about=__doc__,
    cases={name: partial(searched, name) for name in COMPARED},
    key=("kind", "engine", "quantity", "target", "searcher"),
    blocks={
        "outcome": outcome,
        "inputs": inputs,
        "mended": mended,
        "searchers": searchers,
        "footer": partial(generated, "worst"),
    },
    figures={"worst": draw},
    options={
        "seconds": {"type": float, "default": 300.0, "help": "CPU seconds for each engine"},
        "seed": {"type": int, "default": 0},
        "draws": {"type": int, "default": FINAL, "help": "changes of an input behind its unit"},
        "replay": {"action": "store_true", "help": "measure the stored inputs once more"},
    },
)
main = STUDY.main

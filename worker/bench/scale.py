"""A training step over a scene that grows, of which the photo has the same 60,000 Gaussians in view.

    splatmill bench scale                          # 60 thousand to 4 million Gaussians: two minutes, 8 GB
    splatmill bench scale --sides 1 4 --dry        # up to a million, and no row is kept

The scene is ground, seen from above: a square of tiles of 60,000 Gaussians, each as large as what the photo shows. With
`same`, every step is taken on the tile in the middle; with `flight`, each on another place of the ground, so that
clusters come back after a pause. Each is measured with steps that leave out clusters out of view (`clustered`) and with
those that compute all Gaussians (`dense`), by the CPU seconds of the process too, which other programs disturb less.
The second half of the steps counts: first visits touch memory for the first time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import torch
from _page import Column, of_rows
from _rows import Row, footer, of, worked
from _studies.study import Study
from torch import Tensor

from splatmill_worker.kernels.cpu.loss import PhotoStats, photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates

IN_VIEW = 60_000
SIDES = (1, 4, 6, 8)
"""Tiles along a side of the ground: 60 thousand, 1, 2 and 4 million Gaussians."""

WIDTH, HEIGHT, FOCAL = 640, 480, 640.0
K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
ACROSS, DOWN = 4.0, 3.0
"""What a photo shows of the ground from a height of 4, and the sides of a tile."""

RATES = Rates(means=1e-5, log_scales=5e-3, quats=1e-3, logit_opacities=2e-2, sh_dc=2.5e-3, sh_rest=1.25e-4)


def ground(side: int) -> list[Tensor]:
    """Gaussians of about 1.5 pixels on a square of tiles; that in the middle, around the origin, is always the same."""
    parts = []
    for cell in range(side * side):
        i, j = cell // side - side // 2, cell % side - side // 2
        g = torch.Generator().manual_seed(1000 * (i + 500) + j + 500)
        at = torch.tensor([ACROSS * (i - 0.5), DOWN * (j - 0.5), 0.0])
        parts.append(
            [
                torch.rand(IN_VIEW, 3, generator=g) * torch.tensor([ACROSS, DOWN, 0.02]) + at,
                torch.randn(IN_VIEW, 3, generator=g) * 0.3 - 4.7,
                torch.randn(IN_VIEW, 4, generator=g),
                torch.randn(IN_VIEW, generator=g),
                0.15 * torch.randn(IN_VIEW, 16, 3, generator=g),
            ]
        )
    return [torch.cat(group) for group in zip(*parts, strict=True)]


def above(x: float, y: float) -> Tensor:
    """The camera at a height of 4 above a place of the ground, looking down."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-x, -y, 4.0])
    return viewmat


class Timed(NamedTuple):
    """One step, or the medians of several: times in milliseconds, and what was in view and computed."""

    ms: float
    cpu_ms: float
    visible: float
    share_computed: float


def timed(step: Step, viewmat: Tensor, stats: PhotoStats, number: int) -> Timed:
    began, cpu = time.perf_counter(), time.process_time()
    result = step.train(viewmat, K, None, degree=3, rates=RATES, step=number, photo_stats=stats)
    ms, cpu_ms = 1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - cpu)
    return Timed(ms, cpu_ms, result.visible, step.share_computed)


def measure(options: argparse.Namespace) -> Iterator[Row]:
    g = torch.Generator().manual_seed(0)
    stats = photo_stats(torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8, generator=g))
    for side in options.sides:
        groups = ground(side)
        free = (side - 1) * torch.tensor([ACROSS, DOWN])  # a photo in flight shows nothing but ground
        corner = torch.tensor([ACROSS, DOWN]) * -(side // 2)
        for threads, kind in product(options.threads, ("clustered", "dense")):
            step = Step(*groups, threads=threads, clustered=kind == "clustered")
            for views in ("same", "flight"):
                dice = torch.Generator().manual_seed(1)
                each: list[Timed] = []
                others = worked() - time.process_time()
                for number in range(1, options.steps + 1):
                    x, y = (corner + free * torch.rand(2, generator=dice)).tolist()
                    camera = above(x, y) if views == "flight" else above(0.0, 0.0)
                    each.append(timed(step, camera, stats, number))
                others = worked() - time.process_time() - others
                half = zip(*each[len(each) // 2 :], strict=True)
                yield {
                    "bench": "scale", "gaussians": step.count, "threads": threads, "steps": kind, "views": views,
                    "others_cores": 1e3 * others / sum(t.ms for t in each),
                    **Timed(*(statistics.median(values) for values in half))._asdict(),
                }  # fmt: skip
            del step


def times(rows: list[Row]) -> str:
    if not rows:
        return "No rows are committed yet."

    def ratio(row: Row, time: str) -> str:
        alone = of(rows, gaussians=IN_VIEW, threads=row["threads"], steps="dense", views=row["views"])
        return f" ({row[time] / alone[0][time]:.2f})" if alone else ""

    columns: list[Column] = [
        ("threads", "{threads}"), ("Gaussians", "{gaussians:,}"), ("views", "{views}"), ("steps", "{steps}"),
        ("visible", "{visible:,.0f}"), ("clusters computed", lambda r: f"{100 * r['share_computed']:.1f} %"),
        ("ms (over 60,000 alone)", lambda r: f"{r['ms']:.1f}{ratio(r, 'ms')}"),
        ("CPU ms", lambda r: f"{r['cpu_ms']:.1f}{ratio(r, 'cpu_ms')}"),
        ("other programs, cores", "{others_cores:.2f}"),
    ]  # fmt: skip
    return of_rows(columns, rows)


STUDY = Study(
    name="scale",
    about=__doc__,
    cases={"steps": measure},
    key=("gaussians", "threads", "steps", "views"),
    blocks={"times": times, "footer": lambda rows: footer(rows) if rows else ""},
    figures={},
    order=lambda row: (row["threads"], row["gaussians"], row["views"], row["steps"]),
    options={
        "threads": {"type": int, "nargs": "+", "default": (1, 2), "help": "of the kernels"},
        "sides": {"type": int, "nargs": "+", "default": SIDES, "help": "tiles of 60,000 along a side"},
        "steps": {"type": int, "default": 30, "help": "of each measurement"},
    },
)
main = STUDY.main
